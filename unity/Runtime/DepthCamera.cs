using System;
using Unity.Collections;
using UnityEngine;

namespace CapSense
{
    /// <summary>An orthographic camera whose depth and red channel are read back.</summary>
    /// <remarks>
    /// It renders into target textures, as every render pipeline can. The depth texture is copied to a
    /// float texture by a shader of the package. With codes it renders a second time, for colours.
    /// </remarks>
    public sealed class DepthCamera : IDisposable
    {
        /// <summary>Depth of what touches the sensor [m]; 0 would be air.</summary>
        public const float Contact = 1e-6f;

        private readonly Camera camera;
        private readonly int resolution;
        private readonly float range;
        private readonly RenderTexture color, depth, copy;
        private readonly Texture2D depthPixels, colorPixels;
        private readonly Material copier;
        private readonly DepthFrame frame;
        private readonly byte[] rgba;

        /// <param name="parent">The camera stands at its origin and looks along its forward axis.</param>
        /// <param name="resolution">Pixels along either side.</param>
        /// <param name="size">Side of the image [m].</param>
        /// <param name="range">How far it sees [m].</param>
        /// <param name="seen">Layers that it sees.</param>
        /// <param name="codes">Whether the red channel is read.</param>
        public DepthCamera(
            Transform parent, int resolution, float size, float range, LayerMask seen, bool codes)
        {
            this.resolution = resolution;
            this.range = range;
            int pixels = resolution * resolution;
            frame = new DepthFrame(resolution, resolution, new float[pixels], codes ? new byte[pixels] : null);
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
            copier = new Material(Shader.Find("Hidden/CapSense/CopyDepth"));
            depth = Target(32, RenderTextureFormat.Depth);
            copy = Target(0, RenderTextureFormat.RFloat);
            depthPixels = new Texture2D(resolution, resolution, TextureFormat.RFloat, false, true);
            if (!codes) return;
            color = Target(32, RenderTextureFormat.ARGB32);
            colorPixels = new Texture2D(resolution, resolution, TextureFormat.RGBA32, false, true);
            rgba = new byte[4 * pixels];
        }

        /// <summary>Take an image; its first row is the lowest.</summary>
        /// <returns>The same object every time; it is filled anew.</returns>
        public DepthFrame Take(double time)
        {
            camera.targetTexture = depth;
            camera.Render();
            Graphics.Blit(depth, copy, copier);
            Read<float>(copy, depthPixels).CopyTo(frame.Depth);
            bool reversed = SystemInfo.usesReversedZBuffer;
            for (int k = 0; k < frame.Depth.Length; k++)
            {
                // linear, since it is orthographic
                float share = reversed ? 1 - frame.Depth[k] : frame.Depth[k];
                frame.Depth[k] = share < 1 ? Math.Max(share * range, Contact) : 0;
            }
            if (frame.Codes != null) TakeCodes();
            frame.Time = time;
            return frame;
        }

        public void Dispose()
        {
            camera.targetTexture = null;
            foreach (RenderTexture texture in new[] { color, depth, copy })
            {
                if (texture == null) continue;
                texture.Release();
                Destroy(texture);
            }
            Destroy(depthPixels);
            if (colorPixels != null) Destroy(colorPixels);
            Destroy(copier);
            Destroy(camera.gameObject);
        }

        private void TakeCodes()
        {
            camera.targetTexture = color;
            camera.Render();
            Read<byte>(color, colorPixels).CopyTo(rgba);
            for (int k = 0; k < frame.Codes.Length; k++) frame.Codes[k] = rgba[4 * k];
        }

        private RenderTexture Target(int depthBits, RenderTextureFormat format)
        {
            var target = new RenderTexture(
                resolution, resolution, depthBits, format, RenderTextureReadWrite.Linear)
            {
                filterMode = FilterMode.Point,
                antiAliasing = 1,
                hideFlags = HideFlags.HideAndDontSave,
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
