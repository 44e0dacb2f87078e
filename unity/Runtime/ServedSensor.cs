using UnityEngine;

namespace CapSense
{
    /// <summary>What sensors of a CapSense server on game objects have in common.</summary>
    public abstract class ServedSensor : MonoBehaviour
    {
        [Tooltip("Address of the server: capsense serve --design six_patch")]
        public string url = "ws://127.0.0.1:8765";
        [Tooltip("What the server asks for; empty without a token")]
        public string token = "";
        [Tooltip("Design that the server serves; empty for its first")]
        public string design = "";
        [Tooltip("Readings a second; 0: one every frame")]
        public float rate;

        private CapSenseClient client;
        private RemoteSensor remote;
        private float next;
        private bool refused;

        /// <summary>The newest reading; null before the first.</summary>
        public Reading Reading { get; private set; }

        /// <summary>Raised on Unity's own thread with every new reading.</summary>
        public event System.Action<Reading> Received;

        /// <summary>The sensor on the server: electrode names, baseline, errors.</summary>
        public RemoteSensor Remote { get { return remote; } }

        /// <summary>Where the connection stands.</summary>
        public ClientState State { get { return client == null ? ClientState.Stopped : client.State; } }

        /// <summary>Connect, and open the sensor; false, with a message, where the address is wrong.</summary>
        protected bool Open(SensorOptions options)
        {
            try
            {
                client = new CapSenseClient(url, token);
            }
            catch (System.ArgumentException error)
            {
                client = null;
                Debug.LogError("CapSense: " + error.Message, this);
                return false;
            }
            remote = client.Add(options);
            client.Start();
            return true;
        }

        /// <summary>Close the connection.</summary>
        protected void Close()
        {
            if (client != null) client.Dispose();
            client = null;
        }

        /// <summary>Pass on what has come; true where the next reading is due.</summary>
        protected bool Poll()
        {
            if (client == null) return false;
            Reading newest;
            if (remote.TryTake(out newest))
            {
                Reading = newest;
                if (Received != null) Received(newest);
            }
            if (!refused && client.State == ClientState.Refused)
                Debug.LogError("CapSense: " + client.LastError.Message, this);
            refused = client.State == ClientState.Refused;
            if (!remote.Idle || Time.time < next) return false;
            next = rate > 0 ? Mathf.Max(next + 1 / rate, Time.time) : 0;
            return true;
        }
    }
}
