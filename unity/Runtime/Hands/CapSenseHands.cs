using System.Collections.Generic;
using UnityEngine;
using UnityEngine.XR.Hands;

namespace CapSense
{
    /// <summary>A capacitive sensor that senses the hands of the XR Hands package.</summary>
    /// <remarks>
    /// The object's axes are those of <see cref="CapacitiveSensor"/>. Joints are sent as they are
    /// tracked: the server has a model of the hand, smooths its motion and bridges gaps.
    /// Needs the package com.unity.xr.hands; without it this assembly is left out.
    /// </remarks>
    [AddComponentMenu("CapSense/Capacitive Sensor of Hands")]
    public sealed class CapSenseHands : ServedSensor
    {
        [Tooltip("The XR Origin's camera offset, which tracked poses are relative to; none: the world")]
        public Transform origin;
        [Tooltip("female or male: whose hands they are")]
        public string sex = "male";
        [Tooltip("Height of the person [m]; 0: the mean")]
        public float stature;
        [Tooltip("Whether the device reports fingertips on the skin, not inside as OpenXR says")]
        public bool tipsOnSkin;

        private readonly List<XRHandSubsystem> found = new List<XRHandSubsystem>();
        private readonly HandJoints left = new HandJoints(), right = new HandJoints();

        private void OnEnable()
        {
            var build = new Dictionary<string, object> { ["sex"] = sex };
            if (stature > 0) build["stature"] = stature;
            Open(new SensorOptions
            {
                Design = design,
                Material = "human",
                PersonCapacitance = 100e-12,
                Hands = new Dictionary<string, object> { ["build"] = build },
            });
        }

        private void OnDisable()
        {
            Close();
        }

        private void LateUpdate()
        {
            if (Poll()) Remote.Submit(Take(Time.timeAsDouble));
        }

        /// <summary>The hands at present; none without a running hand subsystem.</summary>
        public HandFrame Take(double time)
        {
            var frame = new HandFrame { Time = time };
            SubsystemManager.GetSubsystems(found);
            foreach (XRHandSubsystem subsystem in found)
            {
                if (!subsystem.running) continue;
                frame.Left = Joints(subsystem.leftHand, left);
                frame.Right = Joints(subsystem.rightHand, right);
                break;
            }
            return frame;
        }

        private HandJoints Joints(XRHand hand, HandJoints joints)
        {
            if (!hand.isTracked) return null;
            joints.TipsOnSkin = tipsOnSkin;
            for (int k = 0; k < HandJoints.Count; k++)
            {
                // XR Hands begins with the wrist and the palm, OpenXR with the palm and the wrist
                int at = k < 2 ? 1 - k : k;
                XRHandJoint joint = hand.GetJoint(XRHandJointIDUtility.FromIndex(k));
                Pose pose;
                float radius;
                Vector3 p = joint.TryGetPose(out pose) ? Seen(pose.position) : new Vector3(float.NaN, 0, 0);
                joints.Positions[3 * at] = p.x;
                joints.Positions[3 * at + 1] = p.y;
                joints.Positions[3 * at + 2] = p.z;
                joints.Radii[at] = joint.TryGetRadius(out radius) ? radius : 0;
            }
            return joints;
        }

        /// <summary>A tracked point in the design's axes, which are right-handed.</summary>
        private Vector3 Seen(Vector3 point)
        {
            Vector3 world = origin == null ? point : origin.TransformPoint(point);
            Vector3 local = Quaternion.Inverse(transform.rotation) * (world - transform.position);
            return new Vector3(-local.x, local.y, local.z);
        }
    }
}
