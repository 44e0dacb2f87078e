// As much of UnityEngine as the package needs, so that it compiles and runs without the editor.
// Cameras see what World.Depth and World.Code say.
using System;
using System.Collections.Generic;
using System.Reflection;

namespace Unity.Collections
{
    public struct NativeArray<T> where T : struct
    {
        private readonly T[] items;
        public NativeArray(T[] items) { this.items = items; }
        public void CopyTo(T[] target) { items.CopyTo(target, 0); }
    }
}

namespace UnityEngine
{
    /// <summary>What cameras see, by the position in the image [m], right and up.</summary>
    public static class World
    {
        public static Func<float, float, float> Depth = (x, y) => float.PositiveInfinity;
        public static Func<float, float, byte> Code = (x, y) => 0;
        public static readonly List<Component> Components = new List<Component>();
        public static readonly List<GameObject> Primitives = new List<GameObject>();
    }

    public class Object
    {
        public HideFlags hideFlags;
        public string name;
        public static readonly List<Object> Destroyed = new List<Object>();
        public static void Destroy(Object thing) { Destroyed.Add(thing); }
        public static void DestroyImmediate(Object thing) { }
    }

    public class Component : Object
    {
        public GameObject gameObject;
        public new string name
        {
            get { return gameObject.name; }
            set { gameObject.name = value; }
        }
        public Transform transform { get { return gameObject.transform; } }
    }

    public class Behaviour : Component { public bool enabled = true; }

    public class MonoBehaviour : Behaviour
    {
        /// <summary>Call one of Unity's own methods.</summary>
        public void Tell(string method)
        {
            GetType().GetMethod(method, BindingFlags.Instance | BindingFlags.NonPublic).Invoke(this, null);
        }
    }

    public class GameObject : Object
    {
        public readonly Transform transform;
        public GameObject(string name)
        {
            this.name = name;
            transform = new Transform { gameObject = this };
        }
        public T AddComponent<T>() where T : Component, new()
        {
            var made = new T { gameObject = this };
            World.Components.Add(made);
            return made;
        }
        public static GameObject CreatePrimitive(PrimitiveType type)
        {
            World.Primitives.Add(new GameObject(type.ToString()));
            return World.Primitives[World.Primitives.Count - 1];
        }
    }

    public class Transform : Component
    {
        public Vector3 position, localScale, lossyScale = new Vector3(1, 1, 1);
        public Quaternion rotation = new Quaternion(0, 0, 0, 1);
        public void SetParent(Transform parent, bool keep) { }
        public Vector3 TransformPoint(Vector3 p) { return rotation * p + position; }
    }

    public struct Vector3
    {
        public float x, y, z;
        public static readonly Vector3 right = new Vector3(1, 0, 0), up = new Vector3(0, 1, 0),
            forward = new Vector3(0, 0, 1);
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
        public static Vector3 operator -(Vector3 a, Vector3 b) { return new Vector3(a.x - b.x, a.y - b.y, a.z - b.z); }
    }

    public struct Quaternion
    {
        public float x, y, z, w;
        public Quaternion(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
        public static Quaternion Inverse(Quaternion q) { return new Quaternion(-q.x, -q.y, -q.z, q.w); }
        public static Vector3 operator *(Quaternion q, Vector3 v)
        {
            float tx = 2 * (q.y * v.z - q.z * v.y), ty = 2 * (q.z * v.x - q.x * v.z), tz = 2 * (q.x * v.y - q.y * v.x);
            return new Vector3(v.x + q.w * tx + q.y * tz - q.z * ty, v.y + q.w * ty + q.z * tx - q.x * tz,
                v.z + q.w * tz + q.x * ty - q.y * tx);
        }
        public static Quaternion LookRotation(Vector3 forward, Vector3 up) { return new Quaternion(); }
    }

    public struct Rect { public Rect(float x, float y, float width, float height) { } }

    public struct Color { public static readonly Color clear = new Color(); }

    public struct LayerMask
    {
        private int value;
        public static implicit operator LayerMask(int value) { return new LayerMask { value = value }; }
        public static implicit operator int(LayerMask mask) { return mask.value; }
    }

    public enum HideFlags { None, HideAndDontSave }
    public enum PrimitiveType { Capsule, Cube }
    public enum CameraClearFlags { Skybox, SolidColor }
    public enum FilterMode { Point, Bilinear }
    public static class Debug
    {
        public static readonly List<string> Errors = new List<string>();
        public static void LogError(object message, Object context) { Errors.Add((string)message); }
    }

    public class Shader : Object
    {
        public static Shader Find(string name) { return new Shader { name = name }; }
    }

    public class Material : Object
    {
        public readonly Shader Shader;
        public Material(Shader shader) { Shader = shader; }
    }

    public enum RenderTextureFormat { ARGB32, Depth, RFloat }
    public enum RenderTextureReadWrite { Default, Linear }
    public enum TextureFormat { RFloat, RGBA32 }

    public static class Time
    {
        public static float time;
        public static double timeAsDouble { get { return time; } }
    }

    public static class Mathf
    {
        public static float Sin(float x) { return (float)Math.Sin(x); }
        public static float Max(float a, float b) { return Math.Max(a, b); }
    }

    public static class Application { public static bool isPlaying = true; }
    public static class SystemInfo { public static bool usesReversedZBuffer = true; }

    public class RenderBuffer { internal float[] Depth; internal byte[] Color; }

    public class Texture : Object { public FilterMode filterMode; }

    public class RenderTexture : Texture
    {
        public static RenderTexture active;
        public readonly RenderBuffer colorBuffer = new RenderBuffer(), depthBuffer = new RenderBuffer();
        public int antiAliasing;
        internal readonly int Width, Height;
        public RenderTexture(int width, int height, int depth, RenderTextureFormat format, RenderTextureReadWrite space)
        {
            Width = width;
            Height = height;
            colorBuffer.Color = new byte[4 * width * height];
            colorBuffer.Depth = depthBuffer.Depth = new float[width * height];
        }
        public bool Create() { return true; }
        public void Release() { }
    }

    public class Texture2D : Texture
    {
        private readonly TextureFormat format;
        private RenderTexture source;
        public Texture2D(int width, int height, TextureFormat format, bool mips, bool linear) { this.format = format; }
        public void ReadPixels(Rect rect, int x, int y, bool mips) { source = RenderTexture.active; }
        public Unity.Collections.NativeArray<T> GetRawTextureData<T>() where T : struct
        {
            Array data = format == TextureFormat.RFloat ? (Array)source.colorBuffer.Depth : source.colorBuffer.Color;
            return new Unity.Collections.NativeArray<T>((T[])data);
        }
    }

    public static class Graphics
    {
        public static void Blit(Texture from, RenderTexture to, Material material)
        {
            if (material.Shader.name != "Hidden/CapSense/CopyDepth") throw new InvalidOperationException();
            ((RenderTexture)from).depthBuffer.Depth.CopyTo(to.colorBuffer.Depth, 0);
        }
    }

    public class Camera : Behaviour
    {
        public bool orthographic, allowMSAA, allowHDR;
        public float orthographicSize, aspect, nearClipPlane, farClipPlane;
        public LayerMask cullingMask;
        public CameraClearFlags clearFlags;
        public Color backgroundColor;
        public RenderTexture targetTexture;
        public int Rendered;

        public void Render()
        {
            if (!orthographic || enabled || allowMSAA || allowHDR || nearClipPlane != 0)
                throw new InvalidOperationException("this camera does not measure depths");
            Rendered++;
            RenderBuffer color = targetTexture.colorBuffer, depth = targetTexture.depthBuffer;
            int n = (int)Math.Sqrt(depth.Depth.Length);
            for (int row = 0; row < n; row++)
                for (int column = 0; column < n; column++)
                {
                    float y = ((row + 0.5f) / n * 2 - 1) * orthographicSize;
                    float x = ((column + 0.5f) / n * 2 - 1) * orthographicSize * aspect;
                    float share = (World.Depth(x, y) - nearClipPlane) / (farClipPlane - nearClipPlane);
                    share = Math.Min(share, 1);
                    depth.Depth[row * n + column] = SystemInfo.usesReversedZBuffer ? 1 - share : share;
                    color.Color[4 * (row * n + column)] = World.Code(x, y);
                }
        }
    }

    public class TooltipAttribute : Attribute { public TooltipAttribute(string text) { } }
    public class AddComponentMenuAttribute : Attribute { public AddComponentMenuAttribute(string text) { } }
}
