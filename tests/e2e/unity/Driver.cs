// Runs one task of the package against a server, and prints what came of it as lines of JSON.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Linq;
using System.Threading;
using CapSense;
using UnityEngine;
using UnityEngine.XR.Hands;

public static class Driver
{
    public static int Main(string[] words)
    {
        string url = words.Length > 1 ? words[1] : "", last = words.Length > 2 ? words[2] : "";
        switch (words[0])
        {
            case "json": Echo(); break;
            case "steps": Steps(url, int.Parse(last)); break;
            case "codes": Codes(url); break;
            case "mistakes": Mistakes(url); break;
            case "hello": Hello(url, last, words.Length > 3 ? int.Parse(words[3]) : 1); break;
            case "stay": Stay(url); break;
            case "component": Component(url, last == "reversed"); break;
            case "sample": Sample(url); break;
            case "settings": Settings(url); break;
            case "silent": Silent(url); break;
            case "hands": Hands(url); break;
            default: return 2;
        }
        return 0;
    }

    private static void Print(params object[] pairs)
    {
        var line = new Dictionary<string, object>();
        for (int k = 0; k < pairs.Length; k += 2) line[(string)pairs[k]] = pairs[k + 1];
        Console.WriteLine(Json.Write(line));
        Console.Out.Flush();
    }

    /// <summary>Read lines of JSON, and write each again; "error" for what is none.</summary>
    private static void Echo()
    {
        for (string line = Console.ReadLine(); line != null; line = Console.ReadLine())
        {
            try { Console.WriteLine(Json.Write(Json.Parse(line))); }
            catch (FormatException) { Console.WriteLine("error"); }
        }
    }

    /// <summary>A dome that moves across the view.</summary>
    private static DepthFrame Dome(int k, byte[] codes = null)
    {
        var depth = new float[64 * 64];
        for (int row = 0; row < 64; row++)
            for (int column = 0; column < 64; column++)
            {
                double u = -1 + 2 * column / 63.0 - 0.4 * Math.Sin(0.02 * k), v = -1 + 2 * row / 63.0;
                double squared = u * u + v * v;
                depth[64 * row + column] = squared < 0.25 ? (float)(0.05 + 0.1 * squared) : 0;
            }
        return new DepthFrame(64, 64, depth, codes, 0.01 * k);
    }

    private static void Steps(string url, int count)
    {
        var frames = Enumerable.Range(0, Math.Min(count, 500)).Select(k => Dome(k)).ToArray();
        using (var client = new CapSenseClient(url))
        {
            RemoteSensor sensor = client.Add(new SensorOptions { Material = "steel" });
            client.Start();
            var times = new List<double>();
            var solve = new List<double>();
            Reading reading = null;
            for (int k = 0; k < count; k++)
            {
                var clock = Stopwatch.StartNew();
                reading = sensor.StepAsync(frames[k % frames.Length]).Result;
                times.Add(clock.Elapsed.TotalSeconds);
                solve.Add(reading.WallTime);
                if (k < 3 || k == count - 1)
                    Print("sequence", reading.Sequence, "time", reading.Time, "delta",
                        reading.Delta.Cast<double>().ToArray(), "self", reading.SelfCapacitance,
                        "baseline", sensor.Baseline.Cast<double>().ToArray(), "electrodes",
                        sensor.Electrodes, "channels", sensor.Channels, "codes",
                        reading.Conversions.Select(c => c.Code).ToArray(), "dropped", reading.Dropped);
            }
            Print("round_trip_s", times.Skip(count / 10).ToArray(), "solve_s", solve.Skip(count / 10).ToArray());
        }
    }

    /// <summary>The same dome with permittivity codes: half plastic, half a conductor.</summary>
    private static void Codes(string url)
    {
        using (var client = new CapSenseClient(url))
        {
            RemoteSensor sensor = client.Add(new SensorOptions { Thickness = 0.05 });
            client.Start();
            byte[] codes = Enumerable.Range(0, 64 * 64).Select(k => (byte)(k < 2048 ? 4 : 255)).ToArray();
            Print("delta", sensor.StepAsync(Dome(0, codes)).Result.Delta.Cast<double>().ToArray());
        }
    }

    /// <summary>A frame that the server refuses, a design it does not have; then a good frame.</summary>
    private static void Mistakes(string url)
    {
        using (var client = new CapSenseClient(url))
        {
            RemoteSensor sensor = client.Add(new SensorOptions());
            RemoteSensor unknown = client.Add(new SensorOptions { Design = "unknown" });
            client.Start();
            Print("code", Code(() => sensor.StepAsync(new DepthFrame(300, 300, new float[90000])).Wait()));
            Print("code", Code(() => unknown.StepAsync(Dome(0)).Wait()));
            Print("sequence", sensor.StepAsync(Dome(0)).Result.Sequence, "state", client.State.ToString());
        }
    }

    private static string Code(Action action)
    {
        try { action(); }
        catch (AggregateException error)
        {
            var known = error.GetBaseException() as CapSenseException;
            return known == null ? error.GetBaseException().ToString() : known.Code;
        }
        return "none";
    }

    /// <summary>Say hello with some token and version; what a frame comes to, and the state then.</summary>
    private static void Hello(string url, string token, int protocol)
    {
        using (var client = new CapSenseClient(url, token, protocol))
        {
            RemoteSensor sensor = client.Add(new SensorOptions());
            client.Start();
            string code = Code(() => sensor.StepAsync(Dome(0)).Wait());
            SpinWait.SpinUntil(() => client.State == ClientState.Refused, code == "none" ? 0 : 2000);
            Print("code", code, "state", client.State.ToString());
        }
    }

    /// <summary>Send frames until the connection was lost, made anew, and gave readings again.</summary>
    private static void Stay(string url)
    {
        using (var client = new CapSenseClient(url) { Pause = TimeSpan.FromSeconds(0.1) })
        {
            RemoteSensor sensor = client.Add(new SensorOptions());
            client.Start();
            int readings = 0, frame = 0;
            bool lost = false;
            var limit = Stopwatch.StartNew();
            while (limit.Elapsed.TotalSeconds < 30)
            {
                sensor.Submit(Dome(frame++));
                Thread.Sleep(5);
                if (client.State == ClientState.Waiting && !lost)
                {
                    lost = true;
                    readings = 0;
                    Print("event", "lost");
                }
                Reading reading;
                if (!sensor.TryTake(out reading) || ++readings != 5) continue;
                Print("event", "readings", "electrodes", sensor.Electrodes);
                if (lost) return;
            }
        }
    }

    /// <summary>The component, with an object above, to the right, 60 mm away; as Unity would call it.</summary>
    private static void Component(string url, bool reversed)
    {
        SystemInfo.usesReversedZBuffer = reversed;
        World.Depth = (x, y) => Math.Abs(x - 0.06f) < 0.03f && Math.Abs(y - 0.05f) < 0.03f ? 0.06f : 1;
        World.Code = (x, y) => (byte)(x < 0.06f ? 3 : 9);
        var sensor = new GameObject("sensor").AddComponent<CapacitiveSensor>();
        sensor.url = url;
        sensor.permittivityCodes = true;
        int received = 0;
        sensor.Received += reading => received++;
        sensor.Tell("OnEnable");
        var limit = Stopwatch.StartNew();
        while (received < 3 && limit.Elapsed.TotalSeconds < 10)
        {
            UnityEngine.Time.time += 0.02f;
            sensor.Tell("LateUpdate");
            Thread.Sleep(5);
        }
        Print("delta", sensor.Reading.Delta.Cast<double>().ToArray(), "time", sensor.Reading.Time,
            "received", received);
        sensor.Tell("OnDisable");
        Print("state", sensor.State.ToString());
    }

    /// <summary>No address, then one; a field that changes; frames while an answer is waited for.</summary>
    private static void Settings(string url)
    {
        World.Depth = (x, y) => 0;
        var sensor = new GameObject("sensor").AddComponent<CapacitiveSensor>();
        sensor.url = "";
        sensor.Tell("OnEnable");
        sensor.Tell("LateUpdate");
        Print("errors", UnityEngine.Debug.Errors.ToArray(), "cameras", World.Components.OfType<Camera>().Count());
        sensor.url = url;
        Wait(sensor, () => sensor.Reading != null);
        var camera = World.Components.OfType<Camera>().Single();
        Wait(sensor, () => camera.Rendered > 5);
        int rendered = camera.Rendered, frames = (int)sensor.Reading.Sequence;
        Print("rendered", rendered, "sequence", frames, "self", sensor.Reading.Delta[0, 0]);
        sensor.resolution = 32;
        var first = sensor.Remote;
        Wait(sensor, () => sensor.Remote != first && sensor.Remote.Electrodes != null);
        Print("cameras", World.Components.OfType<Camera>().Count(),
            "textures", UnityEngine.Object.Destroyed.OfType<RenderTexture>().Count());
        var clock = Stopwatch.StartNew();
        sensor.Tell("OnDisable");
        sensor.Tell("OnDisable");
        Print("state", sensor.State.ToString(), "quick", clock.Elapsed.TotalSeconds < 0.5);
    }

    private static void Wait(CapacitiveSensor sensor, Func<bool> done)
    {
        var limit = Stopwatch.StartNew();
        while (!done() && limit.Elapsed.TotalSeconds < 15)
        {
            UnityEngine.Time.time += 0.02f;
            sensor.Tell("LateUpdate");
            Thread.Sleep(1);
        }
        if (!done()) throw new TimeoutException();
    }

    /// <summary>A server that takes frames and never answers is given up.</summary>
    private static void Silent(string url)
    {
        using (var client = new CapSenseClient(url) { AnswerTimeout = TimeSpan.FromSeconds(0.5) })
        {
            RemoteSensor sensor = client.Add(new SensorOptions());
            client.Start();
            try { sensor.StepAsync(Dome(0)).Wait(); }
            catch (AggregateException error) { Print("code", ((CapSenseException)error.InnerException).Code); }
        }
    }

    /// <summary>The sample, a few frames long; what its bars say, and the readings.</summary>
    private static void Sample(string url)
    {
        World.Depth = (x, y) => Math.Abs(x + 0.04f) < 0.05f && Math.Abs(y) < 0.03f ? 0.03f : 1;
        var sample = new GameObject("sample").AddComponent<HandSample>();
        sample.Tell("Start");
        CapacitiveSensor sensor = World.Components.OfType<CapacitiveSensor>().Single();
        sensor.url = url;
        sensor.Tell("OnEnable");
        var limit = Stopwatch.StartNew();
        while (sensor.Reading == null && limit.Elapsed.TotalSeconds < 10)
        {
            UnityEngine.Time.time += 0.02f;
            sample.Tell("Update");
            sensor.Tell("LateUpdate");
            Thread.Sleep(5);
        }
        var bars = World.Primitives.Where(p => p.name.StartsWith("E")).ToArray();
        Print("names", bars.Select(b => b.name).ToArray(),
            "heights", bars.Select(b => b.transform.localScale.y).ToArray(),
            "delta", sensor.Reading.Delta.Cast<double>().ToArray());
        sensor.Tell("OnDisable");
    }

    /// <summary>The component of hands; where things stand comes as JSON. A frame, its reading, no hand.</summary>
    private static void Hands(string url)
    {
        var told = (Dictionary<string, object>)Json.Parse(Console.ReadLine());
        var sensor = new GameObject("sensor").AddComponent<CapSenseHands>();
        sensor.url = url;
        sensor.sex = "female";
        sensor.tipsOnSkin = (bool)told["skin"];
        sensor.transform.position = Vector(told["position"]);
        sensor.transform.rotation = Turn(told["rotation"]);
        sensor.origin = new GameObject("origin").transform;
        sensor.origin.position = Vector(told["origin"]);
        sensor.origin.rotation = Turn(told["turn"]);
        var joints = ((List<object>)told["joints"]).Select(p => new XRHandJoint
        {
            At = p == null ? (UnityEngine.Pose?)null : new UnityEngine.Pose(Vector(p), new Quaternion()),
            Radius = 0.008f,
        }).ToArray();
        var subsystem = new XRHandSubsystem { rightHand = new XRHand { Joints = joints } };
        SubsystemManager.All.Add(new XRHandSubsystem());
        SubsystemManager.All.Add(subsystem);
        Console.WriteLine(sensor.Take(0.5).ToMessage(3, 4));
        subsystem.running = true;
        Console.WriteLine(sensor.Take(0.5).ToMessage(3, 4));
        sensor.Tell("OnEnable");
        var limit = Stopwatch.StartNew();
        int received = 0;
        sensor.Received += reading => received++;
        while (received < 3 && limit.Elapsed.TotalSeconds < 20)
        {
            UnityEngine.Time.time += 0.5f;
            sensor.Tell("LateUpdate");
            Thread.Sleep(5);
        }
        Print("delta", sensor.Reading.Delta.Cast<double>().ToArray(), "state", sensor.State.ToString());
        sensor.Tell("OnDisable");
        Print("state", sensor.State.ToString());
    }

    private static float[] Floats(object list)
    {
        return ((List<object>)list).Select(x => (float)(double)x).ToArray();
    }

    private static Vector3 Vector(object list)
    {
        float[] p = Floats(list);
        return new Vector3(p[0], p[1], p[2]);
    }

    private static Quaternion Turn(object list)
    {
        float[] q = Floats(list);
        return new Quaternion(q[0], q[1], q[2], q[3]);
    }
}
