"""Sensors in simulators: how often they can be read, and how well the ways of seeing agree.

``python benchmarks/worlds.py`` prints the figures of ``docs/mujoco.md``, ``docs/pybullet.md`` and
``docs/depth.md`` about simulators. A reading is the acquisition of the world and the step of the
solver; the simulator's own step is not in it, the rays of its depth camera are. One process, one
thread; times by the clock and, as other programs run too, of the processor.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pybullet as p
from machine import Times, describe_machine, on_one_core

import capsense as cs
from capsense.humans import arm

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "examples"))

import mujoco_forearm  # noqa: E402
from forearm_story import RATE  # noqa: E402

Array = np.ndarray

BODIES = {  # shape, its turn about x, y and z, its lowest point under its middle [m]
    "bar 150 x 150 x 20": (cs.Box((0.15, 0.15, 0.02)), (0.0, 0.0, 0.0), 0.01),
    "bar turned by 23°": (cs.Box((0.15, 0.10, 0.02)), (0.0, 0.0, 0.4), 0.01),
    "forearm, radius 45": (cs.Capsule(0.045, 0.2), (0.0, np.pi / 2, 0.3), 0.045),
    "ball, radius 40": (cs.Sphere(0.04), (0.0, 0.0, 0.0), 0.04),
}
GAPS = (0.010, 0.020, 0.050)
"""Between the sensor and the bodies [m]."""


# -- how often -----------------------------------------------------------------------------------


def ride(
    depth: bool, rate: float, pixels: int = 64, back: str | float = "fill"
) -> tuple[Times, Array, list[int]]:
    """The forearm example: times of its readings but the first, diagonals read [F], unknowns."""
    mujoco_forearm.PIXELS = pixels
    way = mujoco_forearm.Ride(depth)
    model, data, sensor = way.model, way.data, way.sensor
    if back != "fill":
        sensor = cs.mujoco.attach(
            model, data, "wrist_pad", "six_patch", perception="depth_camera",
            default_material="human", default_grounding=100e-12, back=back,
        )  # fmt: skip
    no_sensors = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    times, found, unknowns = Times(), [], []

    def read() -> cs.Reading:
        if depth:
            mujoco.mj_sensorPos(model, data)
        return sensor.read()

    while not way.over:
        model.opt.disableflags &= ~no_sensors
        reading = times.take(read, keep=bool(found))  # the first loads the compiled kernels
        model.opt.disableflags |= no_sensors
        found.append(np.diag(reading.delta))
        unknowns.append(reading.stats.unknowns)
        way.go_on(rate)
    return times, np.array(found), unknowns


def rates() -> None:
    """Print how often the forearm example can be read."""
    print(
        "\nreadings of examples/mujoco_forearm.py: median and 95 % of the processor's time, median"
    )
    print("by the clock [ms]; readings in a second by the mean of the processor's time")
    for depth in (False, True):
        for rate in (RATE, 10 * RATE):
            times, _, unknowns = ride(depth, rate)
            t = times.summary()
            print(
                f"  {'depth, 64 x 64' if depth else 'geometry':15s} sampled at {rate:3.0f} Hz: "
                f"{t['median_ms']:.2f}, {t['p95_ms']:.2f}, {t['clock_median_ms']:.2f}; "
                f"{1e3 / t['mean_ms']:.0f} Hz; {np.mean(unknowns):.0f} unknowns"
            )


def same_ride() -> None:
    """Print how far the depth camera's ride is from that on geometry."""
    print(
        "\nthe same ride seen by the depth camera, over the fingers (first 1.4 s) and over hand and"
    )
    print("forearm: rms difference of an electrode's change, % of its largest in the ride; largest")
    print("difference, % of the largest change at that time")
    exact = ride(False, RATE)[1]
    fingers = np.arange(len(exact)) < 1.4 * RATE
    for pixels, back in ((64, "fill"), (128, "fill"), (64, 0.016), (128, 0.016)):
        off = ride(True, RATE, pixels, back)[1] - exact
        now = np.abs(off).max(axis=1) / exact.max(axis=1)
        for name, part in (("fingers", fingers), ("hand and forearm", ~fingers)):
            rms = np.sqrt(np.mean((off / exact.max(axis=0))[part] ** 2))
            print(
                f"  {pixels} x {pixels}, back {back}, {name}: {100 * rms:.2f}; "
                f"{100 * now[part].max():.1f}"
            )


# -- how well ------------------------------------------------------------------------------------


def seen_by_rays(body: cs.Body, pixels: int) -> cs.DepthFrame:
    """The image that a rangefinder of MuJoCo gives of a body."""
    shape, pose = body.shape, body.pose
    match shape:
        case cs.Box():
            geom = f'type="box" size="{_text(np.divide(shape.size, 2))}"'
        case cs.Capsule():
            geom = f'type="capsule" size="{shape.radius} {shape.length / 2}"'
        case _:
            geom = f'type="sphere" size="{shape.radius}"'
    x, y, z, w = pose.quaternion
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom {geom} pos="{_text(pose.position)}" quat="{w} {x} {y} {z}"/>'
        '<body><geom size=".001"/><site name="pad"/><camera name="pad" euler="180 0 0" '
        f'projection="orthographic" resolution="{pixels} {pixels}" fovy="0.5"/></body></worldbody>'
        '<sensor><rangefinder camera="pad" data="depth"/></sensor></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return cs.mujoco.attach(model, data, "pad", _sim(), perception="depth_camera").frame()


def seen_by_renderer(body: cs.Body, pixels: int) -> cs.DepthFrame:
    """The image that TinyRenderer gives of a mesh of the body."""
    mesh = body.shape.to_trimesh()
    client = p.connect(p.DIRECT)
    pad = p.createMultiBody(0, -1, physicsClientId=client)
    drawn = p.createVisualShape(
        p.GEOM_MESH, vertices=mesh.vertices.tolist(), indices=mesh.faces.ravel().tolist(),
        physicsClientId=client,
    )  # fmt: skip
    p.createMultiBody(
        0, -1, drawn, body.pose.position, body.pose.quaternion, physicsClientId=client
    )
    frame = cs.pybullet.attach(
        client, pad, design=_sim(), perception="depth_camera", resolution=pixels
    ).frame()
    p.disconnect(physicsClientId=client)
    return frame


_SIM: list[cs.Simulator] = []


def _sim() -> cs.Simulator:
    if not _SIM:
        _SIM.append(cs.Simulator("six_patch"))
    return _SIM[0]


def cameras() -> None:
    """Print the depth paths of both simulators against geometry, by gap and resolution."""
    print(
        "\nlargest error of delta, % of its largest entry, of depth images against geometry; worst"
    )
    print("of four places; MuJoCo's rays at 64, 128, 256 pixels over 0.5 m; TinyRenderer likewise")
    rng = np.random.default_rng(0)
    for name, (shape, angles, low) in BODIES.items():
        for gap in GAPS:
            worst = np.zeros(6)
            for _ in range(4):
                place = (*rng.uniform(-0.03, 0.03, 2), low + gap)
                body = cs.Body(shape, cs.Pose.from_euler(place, angles))
                exact = _sim().step(cs.Scene([body])).delta
                frames = [
                    see(body, n) for see in (seen_by_rays, seen_by_renderer) for n in (64, 128, 256)
                ]
                found = [_sim().step(frame).delta for frame in frames]
                error = [np.abs(f - exact).max() / np.abs(exact).max() for f in found]
                worst = np.maximum(worst, error)
            figures = " ".join(f"{100 * w:5.2f}" for w in worst)
            print(f"  {name:20s} {1e3 * gap:3.0f} mm   {figures}", flush=True)


def round_shapes() -> None:
    """Print how far TinyRenderer's round shapes are from what they stand for, 10 mm away."""
    print(
        "\nround shapes as TinyRenderer draws them: depth against the exact one [mm], from and to;"
    )
    print("error of the electrodes' changes, %, from and to")
    n, size, gap = 256, 0.25, 0.010
    x, y = np.meshgrid(*2 * ((np.arange(n) + 0.5) / n * size - size / 2,))
    kinds = {
        "ball": (cs.Sphere(0.04), p.GEOM_SPHERE),
        "capsule": (cs.Capsule(0.045, 0.2), p.GEOM_CAPSULE),
        "cylinder": (cs.Cylinder(0.045, 0.2), p.GEOM_CYLINDER),
    }
    for name, (shape, kind) in kinds.items():
        pose = cs.Pose.from_euler((0.0, 0.0, gap + shape.radius), (np.pi / 2, 0.0, 0.0))
        client = p.connect(p.DIRECT)
        pad = p.createMultiBody(0, -1, physicsClientId=client)
        visual = p.createVisualShape(kind, radius=shape.radius, length=0.2, physicsClientId=client)
        p.createMultiBody(0, -1, visual, pose.position, pose.quaternion, physicsClientId=client)
        sensor = cs.pybullet.attach(
            client, pad, design=_sim(), perception="depth_camera", resolution=n, size=size,
            back=2 * shape.radius,
        )  # fmt: skip
        frame = sensor.frame()
        out = np.hypot(x, y) if name == "ball" else np.where(np.abs(y) < 0.09, np.abs(x), np.inf)
        exact = gap + shape.radius - np.sqrt(np.maximum(shape.radius**2 - out**2, 0.0))
        on = frame.valid.reshape(n, n) & (out < 0.8 * shape.radius)
        off = 1e3 * (frame.depth.reshape(n, n) - exact)[on]
        found = np.diag(sensor.read().delta)
        expected = np.diag(_sim().step(cs.Scene([cs.Body(shape, pose)])).delta)
        change = 100 * (found / expected - 1)
        print(
            f"  {name:8s} {off.min():+.1f}, {off.max():+.1f} mm; {change.min():+.0f}, "
            f"{change.max():+.0f} %"
        )
        p.disconnect(physicsClientId=client)


def simulators() -> None:
    """Print how far the readings of one arm in MuJoCo and in PyBullet are apart."""
    limb, sim, rng, apart = arm(), _sim(), np.random.default_rng(1), []
    for _ in range(20):
        shoulder = cs.Pose.from_euler(
            (rng.uniform(0.35, 0.45), rng.uniform(-0.03, 0.03), rng.uniform(0.08, 0.14)),
            (rng.uniform(-0.1, 0.1), np.pi / 2, rng.uniform(-0.1, 0.1)),
        )
        angles = {
            "elbow_flexion": rng.uniform(0.0, 0.1),
            "forearm_pronation": rng.uniform(-0.8, 0.8),
            "wrist_flexion": rng.uniform(-0.5, 0.5),
        }
        readings = []
        for scene in (
            _arm_in_mujoco(limb, shoulder, angles),
            _arm_in_pybullet(limb, shoulder, angles),
        ):
            sim.reset()
            readings.append(sim.step(scene).delta)
        assert readings[0].max() > 1e-15, "the arm is near"
        apart.append(np.abs(readings[0] - readings[1]).max() / readings[0].max())
    print(
        f"\none arm in MuJoCo (MJCF) and in PyBullet (URDF), {len(apart)} postures: largest "
        f"difference of delta {100 * max(apart):.4f} % of its largest entry"
    )


def _arm_in_mujoco(limb: Any, shoulder: cs.Pose, angles: dict[str, float]) -> cs.Scene:
    spec = mujoco.MjSpec.from_string(limb.mjcf(shoulder))
    spec.worldbody.add_site(name="pad")
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(f"{limb.name}_{name}").qpos[0] = angle
    mujoco.mj_forward(model, data)
    return cs.mujoco.attach(model, data, "pad", _sim()).scene()


def _arm_in_pybullet(limb: Any, shoulder: cs.Pose, angles: dict[str, float]) -> cs.Scene:
    import tempfile

    client = p.connect(p.DIRECT)
    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(limb.urdf())
        file.flush()
        body = p.loadURDF(file.name, shoulder.position, shoulder.quaternion, physicsClientId=client)
    for k in range(p.getNumJoints(body, physicsClientId=client)):
        name = p.getJointInfo(body, k, physicsClientId=client)[1].decode()
        angle = angles.get(name.removeprefix(f"{limb.name}_"), 0.0)
        p.resetJointState(body, k, angle, physicsClientId=client)
    pad = p.createMultiBody(0, physicsClientId=client)
    scene = cs.pybullet.attach(
        client, pad, design=_sim(), default_material="human", default_grounding=100e-12
    ).scene()
    p.disconnect(physicsClientId=client)
    return scene


def _text(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


PARTS = {part.__name__: part for part in (rates, same_ride, cameras, round_shapes, simulators)}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", help=", ".join(PARTS) + "; by default all")
    parts = parser.parse_args().parts or list(PARTS)
    on_one_core()
    machine = describe_machine(("mujoco", "pybullet", "numpy", "numba"))
    print(f"{machine['processor']}, load {machine['load']:.1f}, {machine['versions']}")
    for part in parts:
        PARTS[part]()


if __name__ == "__main__":
    main()
