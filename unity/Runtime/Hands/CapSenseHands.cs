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
    public sealed class CapSenseHands : MonoBehaviour
    {
        [Tooltip("Address of the server: capsense serve --design six_patch")]
        public string url = "ws://127.0.0.1:8765";
        [Tooltip("What the server asks for; empty without a token")]
        public string token = "";
        [Tooltip("Design that the server serves; empty for its first")]
        public string design = "";
        [Tooltip("The XR Origin's camera offset, which tracked poses are relative to; none: the world")]
        public Transform origin;
        [Tooltip("female or male: whose hands they are")]
        public string sex = "male";
        [Tooltip("Height of the person [m]; 0: the mean")]
        public float stature;
        [Tooltip("Whether the device reports fingertips on the skin, not inside as OpenXR says")]
        public bool tipsOnSkin;
        [Tooltip("Frames a second; 0: every frame")]
        public float rate;

        private readonly List<XRHandSubsystem> found = new List<XRHandSubsystem>();
        private readonly HandJoints left = new HandJoints(), right = new HandJoints();
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

        private void OnEnable()
        {
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
            var build = new Dictionary<string, object> { ["sex"] = sex };
            if (stature > 0) build["stature"] = stature;
            remote = client.Add(new SensorOptions
            {
                Design = design,
                Material = "human",
                PersonCapacitance = 100e-12,
                Hands = new Dictionary<string, object> { ["build"] = build },
            });
            client.Start();
        }

        private void OnDisable()
        {
            if (client != null) client.Dispose();
            client = null;
        }

        private void LateUpdate()
        {
            if (client == null) return;
            Reading newest;
            if (remote.TryTake(out newest))
            {
                Reading = newest;
                if (Received != null) Received(newest);
            }
            if (!refused && client.State == ClientState.Refused)
                Debug.LogError("CapSense: " + client.LastError.Message, this);
            refused = client.State == ClientState.Refused;
            if (!remote.Idle || Time.time < next) return;
            next = rate > 0 ? Mathf.Max(next + 1 / rate, Time.time) : 0;
            remote.Submit(Take(Time.timeAsDouble));
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
