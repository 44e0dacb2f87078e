using System;
using System.Collections.Generic;
using System.Linq;
using System.Threading;
using System.Threading.Tasks;

namespace CapSense
{
    /// <summary>What a sensor is, and how its camera looks.</summary>
    /// <remarks>The words of the protocol's <c>open</c>; lengths in metres.</remarks>
    public sealed class SensorOptions
    {
        /// <summary>A design that the server serves; empty for its first.</summary>
        public string Design = "";

        /// <summary>Full extents of the image [m].</summary>
        public double Width = 0.5, Height = 0.5;

        /// <summary>Depths between which something is seen [m].</summary>
        public double Near, Far = 0.5;

        /// <summary>Directions in which the image's indices grow.</summary>
        public string Rows = "+y", Columns = "+x";

        /// <summary>What is seen in frames without permittivity codes.</summary>
        public string Material = "human";

        /// <summary>Whether conductors are grounded; else they float.</summary>
        public bool Grounded = true;

        /// <summary>Capacitance that ties the person to ground [F], in place of
        /// <see cref="Grounded"/>; 0: not given.</summary>
        public double PersonCapacitance;

        /// <summary>Build and filter of tracked hands, in the words of the protocol; null: the
        /// defaults.</summary>
        public IDictionary<string, object> Hands;

        /// <summary>Thickness that is assumed along the view [m]; 0: to the end of the domain.</summary>
        public double Thickness;

        internal string ToMessage(long sensor)
        {
            var open = new Dictionary<string, object>
            {
                ["type"] = "open",
                ["sensor"] = sensor,
                ["camera"] = new Dictionary<string, object>
                {
                    ["width"] = Width, ["height"] = Height, ["near"] = Near, ["far"] = Far,
                    ["rows"] = Rows, ["columns"] = Columns,
                },
                ["material"] = Material,
                ["grounding"] = Grounded ? "grounded" : "floating",
            };
            if (PersonCapacitance > 0) open["grounding"] = PersonCapacitance;
            if (Hands != null) open["hands"] = Hands;
            if (Design.Length > 0) open["design"] = Design;
            if (Thickness > 0) open["back"] = Thickness;
            return Json.Write(open);
        }
    }

    /// <summary>A sensor that the server simulates; made by <see cref="CapSenseClient.Add"/>.</summary>
    /// <remarks>Any thread may call it. It survives the loss of the connection.</remarks>
    public sealed class RemoteSensor
    {
        private readonly CapSenseClient client;
        private readonly object gate = new object();
        private Order waiting, underway;
        private Reading newest;
        private bool open;
        private CapSenseException failure;
        private byte[] buffer = new byte[0];
        private long sequence;

        internal RemoteSensor(CapSenseClient client, long number, SensorOptions options)
        {
            this.client = client;
            Number = number;
            Options = options;
        }

        public readonly long Number;
        public readonly SensorOptions Options;

        /// <summary>Electrode names in matrix order; null until the server has opened the sensor.</summary>
        public IReadOnlyList<string> Electrodes { get; private set; }

        /// <summary>Names of the readout's channels; empty without one.</summary>
        public IReadOnlyList<string> Channels { get; private set; }

        /// <summary>Maxwell matrix of the empty scene [F].</summary>
        public double[,] Baseline { get; private set; }

        /// <summary>Frames that newer ones replaced before they were sent.</summary>
        public long Replaced { get; private set; }

        /// <summary>What was last wrong with a frame of this sensor, or with opening it.</summary>
        public CapSenseException LastError { get; private set; }

        /// <summary>Whether a frame that is submitted now is sent at once.</summary>
        public bool Idle
        {
            get { lock (gate) return open && underway == null && waiting == null; }
        }

        /// <summary>Send a frame as soon as the one before is answered; the newest wins.</summary>
        public void Submit(DepthFrame frame)
        {
            Offer(new Order(frame, null, null));
        }

        /// <summary>Send tracked hands as soon as the frame before is answered; the newest wins.</summary>
        public void Submit(HandFrame frame)
        {
            Offer(new Order(null, frame, null));
        }

        /// <summary>Send a frame, and wait for its reading.</summary>
        /// <exception cref="CapSenseException">The server refused, or the connection was lost.</exception>
        /// <exception cref="OperationCanceledException">A newer frame replaced this one.</exception>
        public Task<Reading> StepAsync(DepthFrame frame)
        {
            return StepAsync(frame, null);
        }

        /// <summary>Send tracked hands, and wait for the reading.</summary>
        /// <exception cref="CapSenseException">The server refused, or the connection was lost.</exception>
        /// <exception cref="OperationCanceledException">A newer frame replaced this one.</exception>
        public Task<Reading> StepAsync(HandFrame frame)
        {
            return StepAsync(null, frame);
        }

        private Task<Reading> StepAsync(DepthFrame frame, HandFrame hands)
        {
            var answer = new TaskCompletionSource<Reading>(TaskCreationOptions.RunContinuationsAsynchronously);
            Offer(new Order(frame, hands, answer));
            return answer.Task;
        }

        /// <summary>The newest reading, if there is one that was not taken yet.</summary>
        public bool TryTake(out Reading reading)
        {
            reading = Interlocked.Exchange(ref newest, null);
            return reading != null;
        }

        private void Offer(Order order)
        {
            Order replaced;
            CapSenseException reason;
            lock (gate)
            {
                reason = failure;
                replaced = waiting;
                waiting = order;
                if (replaced != null) Replaced++;
            }
            if (replaced != null && replaced.Answer != null) replaced.Answer.TrySetCanceled();
            if (reason != null) Fail(reason, ref waiting);
            else Pump();
        }

        /// <summary>Send the frame that waits, unless one is underway or the sensor is not open.</summary>
        private void Pump()
        {
            Order order;
            lock (gate)
            {
                if (!open || underway != null || waiting == null) return;
                order = underway = waiting;
                waiting = null;
                order.Sequence = sequence++;
                order.Sent = DateTime.UtcNow;
            }
            if (order.Hands != null)
            {
                client.SendText(order.Hands.ToMessage(Number, order.Sequence));
                return;
            }
            // One frame is underway at a time, so the buffer is free.
            int size = Wire.SizeOf(order.Frame);
            if (buffer.Length < size) buffer = new byte[size];
            Wire.Pack(buffer, Number, order.Sequence, order.Frame);
            client.Send(new ArraySegment<byte>(buffer, 0, size));
        }

        /// <summary>Whether an answer has been waited for longer than this.</summary>
        internal bool Overdue(TimeSpan limit)
        {
            lock (gate) return underway != null && DateTime.UtcNow - underway.Sent > limit;
        }

        internal void Opened(Dictionary<string, object> message)
        {
            var rows = (List<object>)message["baseline"];
            var baseline = new double[rows.Count, rows.Count];
            for (int i = 0; i < rows.Count; i++)
                for (int j = 0; j < rows.Count; j++)
                    baseline[i, j] = (double)((List<object>)rows[i])[j];
            Baseline = baseline;
            Channels = ((List<object>)message["channels"]).Cast<string>().ToArray();
            Electrodes = ((List<object>)message["electrodes"]).Cast<string>().ToArray();
            lock (gate)
            {
                open = true;
                failure = null;
            }
            Pump();
        }

        internal void Answered(Reading reading)
        {
            Order order = Finish(reading.Sequence);
            Interlocked.Exchange(ref newest, reading);
            if (order != null && order.Answer != null) order.Answer.TrySetResult(reading);
            Pump();
        }

        internal void Refused(CapSenseException error, long number)
        {
            LastError = error;
            if (!open) GiveUp(error);
            Order order = Finish(number);
            if (order != null && order.Answer != null) order.Answer.TrySetException(error);
            Pump();
        }

        /// <summary>The connection is lost; what waits is sent when there is a new one.</summary>
        internal void Lost(CapSenseException error)
        {
            lock (gate)
            {
                open = false;
                failure = null;
            }
            Fail(error, ref underway);
        }

        /// <summary>Nothing will be sent until the sensor is opened, if ever.</summary>
        internal void GiveUp(CapSenseException error)
        {
            lock (gate) failure = error;
            Fail(error, ref waiting);
        }

        private void Fail(CapSenseException error, ref Order place)
        {
            Order order;
            lock (gate)
            {
                order = place;
                place = null;
            }
            if (order != null && order.Answer != null) order.Answer.TrySetException(error);
        }

        private Order Finish(long number)
        {
            lock (gate)
            {
                Order order = underway;
                if (order == null || order.Sequence != number) return null;
                underway = null;
                return order;
            }
        }

        private sealed class Order
        {
            internal readonly DepthFrame Frame;
            internal readonly HandFrame Hands;
            internal readonly TaskCompletionSource<Reading> Answer;
            internal long Sequence;
            internal DateTime Sent;

            internal Order(DepthFrame frame, HandFrame hands, TaskCompletionSource<Reading> answer)
            {
                Frame = frame;
                Hands = hands;
                Answer = answer;
            }
        }
    }
}
