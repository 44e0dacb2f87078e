"""What attaching 17 sensors to a Panda in MuJoCo takes, in a new process and again.

    git clone --depth 1 https://github.com/google-deepmind/mujoco_menagerie
    python benchmarks/panda.py mujoco_menagerie/franka_emika_panda/scene.xml

Two sensors stand on each of eight links, one in the gripper, and a person as a capsule beside the
robot. A first process finds no files of meshes (``CAPSENSE_CACHE_DIR`` is a new folder), the second
finds those of the first; kernels are compiled before. Each attaches twice. Then a geom, a capsule
and a box in turn, gets new sizes, with ``skin.refresh()`` and a reading: "new size" is what that
takes longer than the same again. Times are the processor's and, in brackets, by the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np
from machine import describe_machine
from scipy.spatial.transform import Rotation

import capsense as cs

LINKS = {
    "link0": (0.12, 0.10), "link1": (0.11, -0.10), "link2": (0.11, -0.10), "link3": (0.10, -0.08),
    "link4": (0.10, 0.05), "link5": (0.10, -0.15), "link6": (0.12, 0.0), "link7": (0.10, 0.05),
}  # fmt: skip
"""Distance of the sensors from the z axis of a link and their place along it [m]."""
DESIGNS = "arm_segment", "six_patch", "dual_pad"
SIZES = 12
"""New sizes of each geom."""


def mounted(radius: float, along: float, turn: float) -> cs.Pose:
    """A sensor that faces away from the z axis of a link."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = Rotation.from_matrix([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])
    return cs.Pose((radius * c, radius * s, along), tuple(rotation.as_quat()))


def robot(scene: Path) -> tuple[mujoco.MjModel, mujoco.MjData, dict[str, str]]:
    """The Panda with its sites and a person, and the design of each sensor."""
    spec = mujoco.MjSpec.from_file(str(scene))
    designs = {}
    for link, (radius, along) in LINKS.items():
        for turn in (0.3, 0.3 + np.pi):
            name = f"s{len(designs)}"
            cs.mujoco.add_sensor(spec, link, mounted(radius, along, turn), name)
            designs[name] = DESIGNS[len(designs) % 3]
    cs.mujoco.add_sensor(spec, "hand", cs.Pose((0.0, 0.0, 0.12)), "palm")
    person = spec.worldbody.add_body(name="person", pos=[0.6, 0.2, 0.5])
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    person.add_geom(name="torso", type=capsule, size=[0.12, 0.4, 0.0])
    things = spec.worldbody.add_body(name="things", pos=[0.45, -0.1, 0.6])
    things.add_geom(name="rod", type=capsule, size=[0.02, 0.1, 0.0])
    things.add_geom(
        name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.03, 0.04, 0.05], pos=[0.0, -0.2, 0.0]
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data, {**designs, "palm": "six_patch"}


def now() -> np.ndarray:
    """Processor time and clock [s]."""
    return np.array([time.process_time(), time.perf_counter()])


def measure(scene: Path) -> dict[str, list[float]]:
    """Attach twice, then give geoms new sizes; processor time and clock of each [s]."""
    model, data, designs = robot(scene)
    out = {}
    for name in ("attached", "again"):
        start = now()
        skin = cs.mujoco.attach_skin(
            model, data, list(designs), design=designs, materials={"person": "human"}
        )
        skin.read()
        out[name] = (now() - start).tolist()
    for name in ("rod", "box"):
        geom, spent = model.geom(name), []
        size = geom.size.copy()
        for k in range(SIZES):
            geom.size[:] = size * [1.0, 1.0 + 0.013 * (k + 1), 1.0]
            took = []
            for _ in range(2):
                start = now()
                skin.refresh()
                skin.read()
                took.append(now() - start)
            spent.append(took[0] - took[1])
        out[f"new size of the {name}"] = np.median(spent, axis=0).tolist()
    return out


def main() -> None:
    """Run two processes and print what they took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene.xml of the Panda in MuJoCo Menagerie")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.here:
        warnings.simplefilter("ignore")
        print(json.dumps(measure(args.scene)))
        return
    print(describe_machine(("mujoco",)))
    command = [sys.executable, __file__, str(args.scene), "--here"]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.check_output(command)  # compiles kernels
        environment = {**os.environ, "CAPSENSE_CACHE_DIR": folder}
        for title in ("without files", "with files"):
            found = json.loads(subprocess.check_output(command, env=environment))
            for name, (processor, clock) in found.items():
                scale, unit = (1e3, "ms") if "size" in name else (1.0, "s")
                print(f"{title}: {name} {scale * processor:.3g} {unit} ({scale * clock:.3g})")


if __name__ == "__main__":
    main()
