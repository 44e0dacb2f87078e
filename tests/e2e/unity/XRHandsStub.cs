// As much of com.unity.xr.hands as the package needs; hands are what World.Hands says.
using System.Collections.Generic;

namespace UnityEngine
{
    public struct Pose
    {
        public Vector3 position;
        public Quaternion rotation;
        public Pose(Vector3 position, Quaternion rotation) { this.position = position; this.rotation = rotation; }
    }

    public static class SubsystemManager
    {
        public static readonly List<object> All = new List<object>();
        public static void GetSubsystems<T>(List<T> found)
        {
            found.Clear();
            foreach (object one in All) if (one is T) found.Add((T)one);
        }
    }
}

namespace UnityEngine.XR.Hands
{
    public enum XRHandJointID { Invalid, BeginMarker, Wrist = BeginMarker, Palm, ThumbMetacarpal, EndMarker = 27 }

    public static class XRHandJointIDUtility
    {
        public static XRHandJointID FromIndex(int index) { return (XRHandJointID)(index + 1); }
    }

    public struct XRHandJoint
    {
        public Pose? At;
        public float Radius;
        public bool TryGetPose(out Pose pose)
        {
            pose = At ?? new Pose();
            return At.HasValue;
        }
        public bool TryGetRadius(out float radius)
        {
            radius = Radius;
            return Radius > 0;
        }
    }

    public struct XRHand
    {
        public XRHandJoint[] Joints;
        public bool isTracked { get { return Joints != null; } }
        public XRHandJoint GetJoint(XRHandJointID id) { return Joints[(int)id - 1]; }
    }

    public class XRHandSubsystem
    {
        public bool running { get; set; }
        public XRHand leftHand { get; set; }
        public XRHand rightHand { get; set; }
    }
}
