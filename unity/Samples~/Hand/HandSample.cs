using CapSense;
using UnityEngine;

/// <summary>A capsule moves over a sensor; bars show by how much each electrode's signal rose.</summary>
/// <remarks>
/// Add it to an empty game object, start <c>capsense serve --design six_patch</c>, and press play.
/// </remarks>
public sealed class HandSample : MonoBehaviour
{
    [Tooltip("Change of a self capacitance that makes a bar of one metre [F]")]
    public float fullScale = 1e-12f;

    private Transform hand;
    private Transform[] bars = new Transform[0];
    private CapacitiveSensor sensor;

    private void Start()
    {
        hand = GameObject.CreatePrimitive(PrimitiveType.Capsule).transform;
        hand.localScale = new Vector3(0.08f, 0.1f, 0.08f);  // a capsule of 80 mm, 200 mm long
        hand.rotation = Quaternion.LookRotation(Vector3.up, Vector3.right);  // that lies along x
        var plate = new GameObject("sensor");
        plate.transform.rotation = Quaternion.LookRotation(Vector3.up, Vector3.forward);
        sensor = plate.AddComponent<CapacitiveSensor>();
        sensor.Received += Draw;
    }

    private void Update()
    {
        float t = Time.time;
        hand.position = new Vector3(0.08f * Mathf.Sin(t), 0.08f, 0.05f * Mathf.Sin(0.7f * t));
    }

    private void Draw(Reading reading)
    {
        int count = reading.SelfCapacitance.Length;
        if (bars.Length != count) MakeBars(count);
        for (int k = 0; k < count; k++)
        {
            float height = (float)reading.Delta[k, k] / fullScale;
            bars[k].localScale = new Vector3(0.02f, Mathf.Max(height, 0.001f), 0.02f);
        }
    }

    private void MakeBars(int count)
    {
        bars = new Transform[count];
        for (int k = 0; k < count; k++)
        {
            bars[k] = GameObject.CreatePrimitive(PrimitiveType.Cube).transform;
            bars[k].position = new Vector3(0.3f + 0.03f * k, 0, 0);  // beside what the sensor sees
            bars[k].name = sensor.Remote.Electrodes[k];
        }
    }
}
