"""A skin from a link's mesh to its first reading: ``python benchmarks/skin_make.py LINK.stl``.

Prints the time of each stage, wall-clock and of the processor: reading the file and placing the
electrodes, reporting the cost, building the fields (into an empty cache), attaching the skin to a
MuJoCo model, and the first reading. Kernels are compiled before, see ``capsense warmup``. With
``--resolution`` it prints instead what the coarser panels of patches cost in accuracy.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import mujoco
import numpy as np
from machine import describe_machine

import capsense as cs
from capsense.skin.layout import pad_design

GAPS = (0.001, 0.003, 0.01, 0.03, 0.1)
"""Distances of the bodies of ``--resolution`` [m]."""


@contextmanager
def stage(name: str, total: list[tuple[float, float]]) -> Iterator[None]:
    """Print and keep the time that something takes."""
    wall, busy = time.perf_counter(), time.process_time()
    yield
    spent = time.perf_counter() - wall, time.process_time() - busy
    total.append(spent)
    print(f"  {name}: {spent[0]:.2f} s, processor {spent[1]:.2f} s", flush=True)


def make(options: argparse.Namespace) -> None:
    """Time the stages."""
    warm = cs.Simulator("six_patch")  # compiled kernels are read
    warm.step(cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0.0, 0.0, 0.06)))]))
    spent: list[tuple[float, float]] = []
    with stage("file and placing", spent):
        layout = cs.skin.from_mesh(
            options.link, count=options.count, unit=options.unit, patch=cs.skin.Pad(options.size)
        )
    with stage("report of the cost", spent):
        text = str(layout)
    print("    " + text.replace("\n", "\n    "))
    with stage("fields", spent):
        for design in {id(d): d for d in layout.designs.values()}.values():
            cs.Simulator(design)
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="link")
    first = next(iter(layout.poses().values()))
    hand = first.apply(np.array([0.0, 0.0, 0.06]))
    spec.worldbody.add_geom(
        name="hand", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.04, 0.0, 0.0], pos=hand
    )
    with stage("attaching", spent):
        layout = cs.mujoco.add_skin(spec, "link", layout)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        skin = cs.mujoco.attach_skin(model, data, sites=list(layout), design=layout.designs)
    with stage("first reading", spent):
        readings = skin.read()
    best = max(readings, key=lambda name: readings[name].delta[0, 0])
    wall, busy = np.sum(spent, axis=0)
    print(f"  in all: {wall:.1f} s, processor {busy:.1f} s (target 180 s)")
    print(f"  {len(readings)} readings, the largest +{1e15 * readings[best].delta[0, 0]:.1f} fF")


def resolution() -> None:
    """Print the changes of readings by the coarser panels of patches, %."""
    for radius in (np.inf, 0.044):
        pad = pad_design({"shape": "disc", "radius": 0.006}, 0.012, radius, cs.skin.Pad())
        fine = cs.Simulator(replace(pad, build={"resolution": 1.0}))
        coarse = cs.Simulator(pad)
        for shape, half in ((cs.Sphere(0.04), 0.04), (cs.Box((0.15, 0.15, 0.02)), 0.01)):
            off = []
            for gap in GAPS:
                body = cs.Body(shape, cs.Pose((0.0, 0.0, gap + half)), material="steel")
                one, two = (s.step(cs.Scene([body])).delta[0, 0] for s in (coarse, fine))
                off.append(f"{100 * (one / two - 1):+.1f}")
            print(f"  radius {1e3 * radius:g} mm, {type(shape).__name__}: {' '.join(off)}")


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("link", nargs="?", help="mesh file of the link")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--size", type=float, default=0.012, help="diameter of electrodes [m]")
    parser.add_argument("--unit", default="m")
    parser.add_argument("--resolution", action="store_true")
    options = parser.parse_args()
    machine = describe_machine(("numpy", "numba", "mujoco"))
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load']:.1f}")
    if options.resolution:
        print(f"change by coarser panels at {', '.join(f'{1e3 * g:g}' for g in GAPS)} mm, %:")
        resolution()
    elif options.link is None:
        sys.exit("give the mesh file of a link, such as forearm.stl")
    else:
        with tempfile.TemporaryDirectory() as cache:
            os.environ["CAPSENSE_CACHE_DIR"] = cache
            make(options)


if __name__ == "__main__":
    main()
