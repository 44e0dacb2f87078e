using UnityEngine;

namespace CapSense
{
    /// <summary>A capacitive sensor on a game object, simulated by a CapSense server.</summary>
    /// <remarks>
    /// The object's forward axis points out of the sensor, up is the design's y axis, and left its
    /// x axis (Unity is left-handed, designs are not). One unit is one metre, whatever the scale of
    /// the object. A camera of its own looks out of the sensor and takes depth images; with
    /// <see cref="permittivityCodes"/> it also takes the red channel, which is the relative
    /// permittivity where objects wear the CapSense/Permittivity shader.
    /// </remarks>
    [AddComponentMenu("CapSense/Capacitive Sensor")]
    public sealed class CapacitiveSensor : MonoBehaviour
    {
        [Tooltip("Address of the server: capsense serve --design six_patch")]
        public string url = "ws://127.0.0.1:8765";
        [Tooltip("What the server asks for; empty without a token")]
        public string token = "";
        [Tooltip("Design that the server serves; empty for its first")]
        public string design = "";
        [Tooltip("What everything is made of, without permittivity codes")]
        public string material = "human";
        [Tooltip("Read relative permittivities from the red channel")]
        public bool permittivityCodes;
        [Tooltip("Pixels along either side of the image")]
        public int resolution = 64;
        [Tooltip("Side of the image [m]")]
        public float size = 0.5f;
        [Tooltip("How far the sensor sees [m]")]
        public float range = 0.5f;
        [Tooltip("Images a second; 0: one every frame")]
        public float rate;
        [Tooltip("Layers that the sensor sees")]
        public LayerMask seen = ~0;

        private CapSenseClient client;
        private RemoteSensor remote;
        private DepthCamera view;
        private float next;
        private bool refused;
        private Settings made;

        /// <summary>The newest reading; null before the first.</summary>
        public Reading Reading { get; private set; }

        /// <summary>Raised on Unity's own thread with every new reading.</summary>
        public event System.Action<Reading> Received;

        /// <summary>The sensor on the server: electrode names, baseline, errors.</summary>
        public RemoteSensor Remote { get { return remote; } }

        /// <summary>Where the connection stands.</summary>
        public ClientState State { get { return client == null ? ClientState.Stopped : client.State; } }

        private void OnEnable()
        {
            made = Wanted;
            try
            {
                client = new CapSenseClient(url, token);
            }
            catch (System.ArgumentException error)
            {
                client = null;
                Debug.LogError("CapSense: " + error.Message, this);
                return;
            }
            remote = client.Add(new SensorOptions
            {
                Design = design,
                Width = size,
                Height = size,
                Far = range,
                Columns = "-x",
                Material = material,
            });
            view = new DepthCamera(transform, resolution, size, range, seen, permittivityCodes);
            client.Start();
        }

        private void OnDisable()
        {
            if (client != null) client.Dispose();
            if (view != null) view.Dispose();
            client = null;
            view = null;
        }

        private void LateUpdate()
        {
            if (!made.Equals(Wanted))
            {
                OnDisable();
                OnEnable();
            }
            if (client == null) return;
            Reading found;
            if (remote.TryTake(out found))
            {
                Reading = found;
                if (Received != null) Received(found);
            }
            if (!refused && client.State == ClientState.Refused)
                Debug.LogError("CapSense: " + client.LastError.Message, this);
            refused = client.State == ClientState.Refused;
            // while an answer is waited for nothing is rendered
            if (!remote.Idle || Time.time < next) return;
            next = rate > 0 ? Mathf.Max(next + 1 / rate, Time.time) : 0;
            remote.Submit(view.Take(Time.timeAsDouble));
        }

        private Settings Wanted
        {
            get
            {
                return new Settings
                {
                    Url = url, Token = token, Design = design, Material = material,
                    Codes = permittivityCodes, Resolution = resolution, Size = size, Range = range, Seen = seen,
                };
            }
        }

        /// <summary>What needs a new connection, or a new camera, when it changes.</summary>
        private struct Settings : System.IEquatable<Settings>
        {
            internal string Url, Token, Design, Material;
            internal bool Codes;
            internal int Resolution, Seen;
            internal float Size, Range;

            public bool Equals(Settings other)
            {
                return Url == other.Url && Token == other.Token && Design == other.Design
                    && Material == other.Material && Codes == other.Codes && Resolution == other.Resolution
                    && Seen == other.Seen && Size.Equals(other.Size) && Range.Equals(other.Range);
            }
        }
    }
}
