using System;
using Unity.Collections;
using UnityEngine;

namespace CapSense
{
    /// <summary>An orthographic camera whose depth and red channel are read back.</summary>
    public sealed class DepthCamera : IDisposable
    {
        private readonly Camera camera;
        private readonly bool codes;
        private readonly int resolution;
        private readonly float range;
        private readonly RenderTexture color, depth, copy;
        private readonly Texture2D depthPixels, colorPixels;

        /// <param name="parent">The camera stands at its origin and looks along its forward axis.</param>
        /// <param name="resolution">Pixels along either side.</param>
        /// <param name="size">Side of the image [m].</param>
        /// <param name="range">How far it sees [m].</param>
        /// <param name="seen">Layers that it sees.</param>
        /// <param name="codes">Whether the red channel is read.</param>
        public DepthCamera(
            Transform parent, int resolution, float size, float range, LayerMask seen, bool codes)
        {
            this.codes = codes;
            this.resolution = resolution;
            this.range = range;
            var holder = new GameObject("CapSense camera") { hideFlags = HideFlags.HideAndDontSave };
            holder.transform.SetParent(parent, false);
            Vector3 scale = parent.lossyScale;  // sizes are metres, whatever the parent's scale
            holder.transform.localScale = new Vector3(1 / scale.x, 1 / scale.y, 1 / scale.z);
            camera = holder.AddComponent<Camera>();
            camera.enabled = false;  // it renders when asked to
            camera.orthographic = true;
            camera.orthographicSize = size / 2;  // half the height
            camera.aspect = 1;
            camera.nearClipPlane = 0;
            camera.farClipPlane = range;
            camera.cullingMask = seen;
            camera.clearFlags = CameraClearFlags.SolidColor;
            camera.backgroundColor = Color.clear;
            camera.allowMSAA = false;  // codes and depths must not be blended
            camera.allowHDR = false;
            color = Target(0, RenderTextureFormat.ARGB32);
            depth = Target(32, RenderTextureFormat.Depth);
            copy = Target(0, RenderTextureFormat.RFloat);
            depthPixels = new Texture2D(resolution, resolution, TextureFormat.RFloat, false, true);
            colorPixels = new Texture2D(resolution, resolution, TextureFormat.RGBA32, false, true);
            camera.SetTargetBuffers(color.colorBuffer, depth.depthBuffer);
        }

        /// <summary>Take an image; its first row is the lowest.</summary>
        public DepthFrame Take(double time)
        {
            camera.Render();
            Graphics.Blit(depth, copy);
            NativeArray<float> raw = Read<float>(copy, depthPixels);
            var metres = new float[resolution * resolution];
            bool reversed = SystemInfo.usesReversedZBuffer;
            for (int k = 0; k < metres.Length; k++)
            {
                float share = reversed ? 1 - raw[k] : raw[k];  // linear, since it is orthographic
                metres[k] = share < 1 ? Math.Max(share * range, float.Epsilon) : 0;
            }
            return new DepthFrame(resolution, resolution, metres, codes ? Red() : null, time);
        }

        public void Dispose()
        {
            foreach (RenderTexture texture in new[] { color, depth, copy }) texture.Release();
            Destroy(depthPixels);
            Destroy(colorPixels);
            Destroy(camera.gameObject);
        }

        private byte[] Red()
        {
            NativeArray<byte> raw = Read<byte>(color, colorPixels);
            var red = new byte[resolution * resolution];
            for (int k = 0; k < red.Length; k++) red[k] = raw[4 * k];
            return red;
        }

        private RenderTexture Target(int depthBits, RenderTextureFormat format)
        {
            var target = new RenderTexture(
                resolution, resolution, depthBits, format, RenderTextureReadWrite.Linear)
            {
                filterMode = FilterMode.Point,
                antiAliasing = 1,
            };
            target.Create();
            return target;
        }

        private NativeArray<T> Read<T>(RenderTexture source, Texture2D target) where T : struct
        {
            RenderTexture before = RenderTexture.active;
            RenderTexture.active = source;
            target.ReadPixels(new Rect(0, 0, resolution, resolution), 0, 0, false);
            RenderTexture.active = before;
            return target.GetRawTextureData<T>();
        }

        private static void Destroy(UnityEngine.Object thing)
        {
            if (Application.isPlaying) UnityEngine.Object.Destroy(thing);
            else UnityEngine.Object.DestroyImmediate(thing);
        }
    }
}
