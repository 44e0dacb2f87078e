"""Check CapSense against a running CoppeliaSim: start one with any scene, then run this.

What it needs is put 10 m above the scene, and removed at the end.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

import capsense as cs

PLACE = cs.Pose((0.0, 0.0, 10.0), (0.1, 0.3, -0.2, 0.9))
"""Where the sensor stands in the world."""
PIXELS = 125
"""Along each side of the image, which is 0.5 m wide: 4 mm each."""
BAR = cs.Box((0.148, 0.100, 0.020))
AHEAD = cs.Pose((0.004, -0.008, 0.050))
BLOCK = cs.Box((0.020, 0.020, 0.020))
BLOCKS = {"glass": cs.Pose((0.152, 0.080, 0.100)), "steel": cs.Pose((-0.120, 0.152, 0.200))}


def put(sim: Any, name: str, shape: cs.Box, pose: cs.Pose) -> int:
    """Add a box that stays where it is; its pose is in the sensor frame."""
    handle = sim.createPrimitiveShape(sim.primitiveshape_cuboid, list(shape.size), 0)
    sim.setObjectAlias(handle, f"capsense_{name}")
    sim.setObjectInt32Param(handle, sim.shapeintparam_static, 1)
    move(sim, handle, pose)
    return handle


def move(sim: Any, handle: int, pose: cs.Pose) -> None:
    """Put something where its pose in the sensor frame says."""
    pose = PLACE @ pose
    sim.setObjectPose(handle, [*pose.position, *pose.quaternion], sim.handle_world)


def centre(frame: cs.DepthFrame, near: cs.Pose) -> np.ndarray:
    """Middle of what is seen around a place [m], in the sensor frame."""
    points = frame.points()
    seen = points[np.abs(points[:, :2] - near.position[:2]).max(axis=1) < 0.02]
    return seen.mean(axis=0) if len(seen) else np.full(3, np.nan)


def checks(sim: Any, bar: int) -> Iterator[tuple[str, float, float]]:
    """What is checked, how far off it is, and how far it may be."""
    simulator = cs.Simulator("six_patch")
    sensor = cs.coppeliasim.attach(
        sim, "/capsense_dummy", simulator, materials={"capsense_glass": "glass"},
        resolution=PIXELS, back=0.02,
    )  # fmt: skip
    with cs.coppeliasim.running(sim) as step:
        before = step()
        frame = sensor.frame()
        for name, pose in BLOCKS.items():
            off = np.abs(centre(frame, pose) - pose.position - (0, 0, -0.01))
            yield f"the {name} block is in its place in the image, in mm", 1e3 * off[:2].max(), 2.0
            yield f"the {name} block is at its depth, in mm", 1e3 * off[2], 0.2
        dielectrics = set(np.unique(frame.permittivity)) - {0.0, np.inf}
        yield "the red channel tells glass, eps_r 5", abs(sum(dielectrics) - 5.0), 0.0
        yield "and conductors", float(np.inf not in frame.permittivity), 0.0
        yield "where the sensor stands, in mm", 1e3 * apart(sensor.pose, PLACE), 0.01
        for place in (AHEAD, cs.Pose((0.024, 0.012, 0.030))):
            move(sim, bar, place)
            now = step()
            yield "a step moves the time on, in s", float(now <= before), 0.0
            reading = sensor.read().delta.diagonal()
            yield "the reading against the shapes', in %", 100 * error(reading, simulator, place), 5
            before = now
        several = float(sensor.vision_sensor.script is None)
        yield "a read is one remote call (CoppeliaSim 4.7 or later)", several, 0.0
    sensor.remove()


def apart(a: cs.Pose, b: cs.Pose) -> float:
    """Distance of two poses [m], 0.1 m out along each axis."""
    arms = 0.1 * np.eye(3)
    return float(np.linalg.norm(a.apply(arms) - b.apply(arms), axis=1).max())


def error(found: np.ndarray, simulator: cs.Simulator, bar: cs.Pose) -> float:
    """Largest difference from the reading of the shapes themselves, relative."""
    bodies = [cs.Body(BLOCK, pose, name) for name, pose in BLOCKS.items()]
    expected = simulator.step(cs.Scene([*bodies, cs.Body(BAR, bar)])).delta.diagonal()
    return float(np.abs(found / expected - 1).max())


def main(port: int) -> None:
    """Make a scene, check it, and remove it.

    Raises:
        SystemExit: Something is not as it should be.
    """
    sim = cs.coppeliasim.connect(port=port)
    made = [sim.createDummy(0.01)]
    sim.setObjectAlias(made[0], "capsense_dummy")
    move(sim, made[0], cs.Pose())
    made += [put(sim, name, BLOCK, pose) for name, pose in BLOCKS.items()]
    made.append(put(sim, "bar", BAR, AHEAD))
    wrong = 0
    try:
        for what, found, bound in checks(sim, made[-1]):
            right = found <= bound
            wrong += not right
            print(f"{'ok   ' if right else 'WRONG'}  {what}: {found:.3g}, at most {bound:g}")
    finally:
        sim.removeObjects(made)
    if wrong:
        raise SystemExit(f"{wrong} checks failed; please report them with your CoppeliaSim version")
    print("all as it should be")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--port", type=int, default=23000, help="of the remote API server")
    main(parser.parse_args().port)
