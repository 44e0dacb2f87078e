using System;
using System.Collections.Generic;

namespace CapSense
{
    /// <summary>The joints of one tracked hand, in OpenXR's order.</summary>
    public sealed class HandJoints
    {
        /// <summary>How many joints a hand has: palm, wrist, four of the thumb, five of each finger.</summary>
        public const int Count = 26;

        /// <summary>Positions [m] in the design's axes, x, y, z of joint after joint; NaN: not seen.</summary>
        public readonly float[] Positions = new float[3 * Count];

        /// <summary>Distances of the joints from the skin [m]; 0: not known.</summary>
        public readonly float[] Radii = new float[Count];

        /// <summary>How sure the tracker is, from 0 to 1.</summary>
        public float Confidence = 1;

        /// <summary>Whether the tips lie on the skin; else inside by their radius, as OpenXR says.</summary>
        public bool TipsOnSkin;

        internal Dictionary<string, object> ToTable(string side)
        {
            var joints = new object[Count];
            var radii = new object[Count];
            for (int k = 0; k < Count; k++)
            {
                float x = Positions[3 * k], y = Positions[3 * k + 1], z = Positions[3 * k + 2];
                if (Finite(x) && Finite(y) && Finite(z)) joints[k] = new[] { x, y, z };
                if (Finite(Radii[k]) && Radii[k] > 0) radii[k] = Radii[k];
            }
            return new Dictionary<string, object>
            {
                ["side"] = side, ["convention"] = "openxr", ["tip"] = TipsOnSkin ? "skin" : "inside",
                ["confidence"] = Math.Min(Math.Max(Confidence, 0), 1), ["joints"] = joints, ["radii"] = radii,
            };
        }

        private static bool Finite(float value)
        {
            return !float.IsNaN(value) && !float.IsInfinity(value);
        }
    }

    /// <summary>What a tracker sees of both hands; the server has their model and filters them.</summary>
    public sealed class HandFrame
    {
        /// <summary>The hands; null where one is not tracked.</summary>
        public HandJoints Left, Right;

        /// <summary>Time [s]; later than that of the frame before.</summary>
        public double Time;

        /// <summary>The message of this frame.</summary>
        public string ToMessage(long sensor, long sequence)
        {
            var hands = new List<object>();
            if (Left != null) hands.Add(Left.ToTable("left"));
            if (Right != null) hands.Add(Right.ToTable("right"));
            return Json.Write(new Dictionary<string, object>
            {
                ["type"] = "hands", ["sensor"] = sensor, ["sequence"] = sequence, ["time"] = Time,
                ["hands"] = hands,
            });
        }
    }
}
