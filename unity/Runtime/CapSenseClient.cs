using System;
using System.Collections.Generic;
using System.Linq;
using System.Net.WebSockets;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace CapSense
{
    /// <summary>Where a client stands with its server.</summary>
    public enum ClientState
    {
        Stopped,
        Connecting,
        Connected,

        /// <summary>The server cannot be reached; the client tries again and again.</summary>
        Waiting,

        /// <summary>The server will not have this client; see <see cref="CapSenseClient.LastError"/>.</summary>
        Refused,
    }

    /// <summary>A connection to a CapSense server that opens its sensors anew when it was lost.</summary>
    /// <remarks>
    /// Needs nothing beyond the .NET base library. All work is done on threads of the pool;
    /// <see cref="Event"/> is raised there.
    /// </remarks>
    public sealed class CapSenseClient : IDisposable
    {
        private static readonly HashSet<string> Final = new HashSet<string> { "version", "token" };

        private readonly Uri uri;
        private readonly string token;
        private readonly int protocol;
        private readonly object gate = new object();
        private readonly Dictionary<long, RemoteSensor> sensors = new Dictionary<long, RemoteSensor>();
        private readonly SemaphoreSlim sending = new SemaphoreSlim(1, 1);
        private readonly CancellationTokenSource stop = new CancellationTokenSource();
        private ClientWebSocket socket;
        private Task work;

        /// <param name="url">Such as ws://127.0.0.1:8765.</param>
        /// <exception cref="ArgumentException">It is no such address.</exception>
        /// <param name="token">What the server was told to ask for.</param>
        /// <param name="protocol">Version that is announced; for tests.</param>
        public CapSenseClient(string url, string token = "", int protocol = Wire.Protocol)
        {
            if (!Uri.TryCreate(url, UriKind.Absolute, out uri) || (uri.Scheme != "ws" && uri.Scheme != "wss"))
                throw new ArgumentException("'" + url + "' is no address of a server, such as ws://127.0.0.1:8765");
            this.token = token ?? "";
            this.protocol = protocol;
        }

        /// <summary>Raised with a line of text when the state changes or something goes wrong.</summary>
        public event Action<string> Event;

        public ClientState State { get; private set; }

        /// <summary>The last error of the connection.</summary>
        public Exception LastError { get; private set; }

        /// <summary>First and longest pause before the next attempt to connect.</summary>
        public TimeSpan Pause = TimeSpan.FromSeconds(0.25), LongestPause = TimeSpan.FromSeconds(5);

        /// <summary>Longest wait for the server's welcome, and for the answer to a frame.</summary>
        public TimeSpan Timeout = TimeSpan.FromSeconds(5), AnswerTimeout = TimeSpan.FromSeconds(10);

        /// <summary>Want a sensor; it is opened as soon as there is a connection.</summary>
        public RemoteSensor Add(SensorOptions options)
        {
            RemoteSensor sensor;
            lock (gate)
            {
                sensor = new RemoteSensor(this, sensors.Count, options);
                sensors.Add(sensor.Number, sensor);
                if (State != ClientState.Connected) return sensor;
            }
            SendText(options.ToMessage(sensor.Number));
            return sensor;
        }

        /// <summary>Connect, and stay connected until disposed of.</summary>
        public void Start()
        {
            lock (gate)
                if (work == null) work = Task.Run(StayConnected);
        }

        /// <summary>Close the connection and stop; does not wait for the server.</summary>
        public void Dispose()
        {
            lock (gate)
            {
                stop.Cancel();
                State = ClientState.Stopped;
            }
            ClientWebSocket current = socket;
            if (current != null) current.Abort();
        }

        private async Task StayConnected()
        {
            TimeSpan pause = Pause;
            while (!stop.IsCancellationRequested)
            {
                var lost = new CapSenseException("closed", "the connection was lost");
                try
                {
                    using (socket = new ClientWebSocket())
                    {
                        Enter(ClientState.Connecting, uri.ToString());
                        await Greet().ConfigureAwait(false);
                        pause = Pause;
                        using (new Timer(_ => Watch(), null, 1000, 1000))
                            await Receive().ConfigureAwait(false);
                    }
                }
                catch (CapSenseException error)
                {
                    LastError = lost = error;
                }
                catch (Exception error) when (!(error is OutOfMemoryException))
                {
                    LastError = error;
                }
                bool refused = Final.Contains(lost.Code);
                foreach (RemoteSensor sensor in All())
                {
                    sensor.Lost(lost);
                    if (refused || stop.IsCancellationRequested) sensor.GiveUp(lost);
                }
                if (refused) Enter(ClientState.Refused, lost.Message);
                if (refused || stop.IsCancellationRequested) return;
                Enter(ClientState.Waiting, LastError == null ? "" : LastError.Message);
                try
                {
                    await Task.Delay(pause, stop.Token).ConfigureAwait(false);
                }
                catch (OperationCanceledException)
                {
                    foreach (RemoteSensor sensor in All()) sensor.GiveUp(lost);
                    return;
                }
                pause = TimeSpan.FromTicks(Math.Min(2 * pause.Ticks, LongestPause.Ticks));
            }
        }

        /// <summary>Connect, say hello, and open all sensors.</summary>
        private async Task Greet()
        {
            using (var limit = CancellationTokenSource.CreateLinkedTokenSource(stop.Token))
            {
                limit.CancelAfter(Timeout);
                await socket.ConnectAsync(uri, limit.Token).ConfigureAwait(false);
                SendText(Json.Write(new Dictionary<string, object>
                {
                    ["type"] = "hello", ["protocol"] = protocol, ["token"] = token, ["client"] = "unity",
                }));
                var message = new Incoming();
                await Next(message, limit.Token).ConfigureAwait(false);
                Handle(message);
            }
            RemoteSensor[] known;
            lock (gate)
            {
                if (stop.IsCancellationRequested) return;
                State = ClientState.Connected;  // whatever is added from now on opens itself
                known = All();
            }
            foreach (RemoteSensor sensor in known) SendText(sensor.Options.ToMessage(sensor.Number));
            Say("connected");
        }

        /// <summary>Give a connection up that does not answer.</summary>
        private void Watch()
        {
            if (!All().Any(sensor => sensor.Overdue(AnswerTimeout))) return;
            ClientWebSocket current = socket;
            if (current != null) current.Abort();
        }

        private async Task Receive()
        {
            var message = new Incoming();
            while (await Next(message, stop.Token).ConfigureAwait(false)) Handle(message);
        }

        /// <summary>Receive one whole message; false when the connection is closed.</summary>
        private async Task<bool> Next(Incoming message, CancellationToken cancel)
        {
            message.Count = 0;
            while (true)
            {
                if (message.Count == message.Data.Length) Array.Resize(ref message.Data, 2 * message.Count);
                var free = new ArraySegment<byte>(message.Data, message.Count, message.Data.Length - message.Count);
                WebSocketReceiveResult result = await socket.ReceiveAsync(free, cancel).ConfigureAwait(false);
                if (result.MessageType == WebSocketMessageType.Close)
                {
                    string reason = result.CloseStatusDescription;
                    throw new CapSenseException(string.IsNullOrEmpty(reason) ? "closed" : reason,
                        "the server closed the connection: " + (int?)result.CloseStatus + " " + reason);
                }
                message.Count += result.Count;
                message.Text = result.MessageType == WebSocketMessageType.Text;
                if (result.EndOfMessage) return true;
            }
        }

        private void Handle(Incoming incoming)
        {
            RemoteSensor sensor;
            if (!incoming.Text)
            {
                Reading reading = Wire.Unpack(incoming.Data, incoming.Count, out long number);
                if (Find(number, out sensor)) sensor.Answered(reading);
                return;
            }
            var message = (Dictionary<string, object>)Json.Parse(
                Encoding.UTF8.GetString(incoming.Data, 0, incoming.Count));
            switch ((string)message["type"])
            {
                case "opened":
                    if (Find((long)(double)message["sensor"], out sensor)) sensor.Opened(message);
                    break;
                case "error":
                    Fail(message);
                    break;
            }
        }

        private void Fail(Dictionary<string, object> message)
        {
            var error = new CapSenseException((string)message["code"], (string)message["message"]);
            Say(error.Code + ": " + error.Message);
            if (message.TryGetValue("sensor", out object number) && Find((long)(double)number, out var sensor))
            {
                message.TryGetValue("sequence", out object sequence);
                sensor.Refused(error, sequence is double ? (long)(double)sequence : -1);
                return;
            }
            throw error;
        }

        private bool Find(long number, out RemoteSensor sensor)
        {
            lock (gate) return sensors.TryGetValue(number, out sensor);
        }

        private RemoteSensor[] All()
        {
            lock (gate)
            {
                var all = new RemoteSensor[sensors.Count];
                sensors.Values.CopyTo(all, 0);
                return all;
            }
        }

        internal void Send(ArraySegment<byte> data)
        {
            Send(data, WebSocketMessageType.Binary);
        }

        internal void SendText(string text)
        {
            Send(new ArraySegment<byte>(Encoding.UTF8.GetBytes(text)), WebSocketMessageType.Text);
        }

        /// <summary>Send one message after the other; the receiver notices a lost connection.</summary>
        private async void Send(ArraySegment<byte> data, WebSocketMessageType type)
        {
            ClientWebSocket current = socket;
            await sending.WaitAsync().ConfigureAwait(false);
            try
            {
                await current.SendAsync(data, type, true, stop.Token).ConfigureAwait(false);
            }
            catch (Exception error) when (!(error is OutOfMemoryException))
            {
                LastError = error;
                current.Abort();
            }
            finally
            {
                sending.Release();
            }
        }

        private void Enter(ClientState state, string why)
        {
            lock (gate)
            {
                if (stop.IsCancellationRequested) return;
                State = state;
            }
            Say(state.ToString().ToLowerInvariant() + ": " + why);
        }

        private void Say(string line)
        {
            Action<string> handlers = Event;
            if (handlers != null) handlers(line);
        }

        private sealed class Incoming
        {
            internal byte[] Data = new byte[16384];
            internal int Count;
            internal bool Text;
        }
    }
}
