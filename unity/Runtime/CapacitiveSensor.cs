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
    public sealed class CapacitiveSensor : ServedSensor
    {
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
        [Tooltip("Layers that the sensor sees")]
        public LayerMask seen = ~0;

        private DepthCamera view;
        private Settings made;

        private void OnEnable()
        {
            made = Wanted;
            bool opened = Open(new SensorOptions
            {
                Design = design,
                Width = size,
                Height = size,
                Far = range,
                Columns = "-x",
                Material = material,
            });
            if (opened) view = new DepthCamera(transform, resolution, size, range, seen, permittivityCodes);
        }

        private void OnDisable()
        {
            Close();
            if (view != null) view.Dispose();
            view = null;
        }

        private void LateUpdate()
        {
            if (!made.Equals(Wanted))
            {
                OnDisable();
                OnEnable();
            }
            // while an answer is waited for nothing is rendered
            if (Poll()) Remote.Submit(view.Take(Time.timeAsDouble));
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
