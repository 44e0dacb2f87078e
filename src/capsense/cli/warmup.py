"""``capsense warmup``: compile all kernels ahead of time."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator
from time import perf_counter
from typing import TYPE_CHECKING, Any

from capsense.cli import OK, arg, command, say

if TYPE_CHECKING:
    from capsense.scene import Body

Stage = tuple[str, Callable[[], object]]


@command("warmup", "compile all kernels ahead of time", arg("-q --quiet", "print nothing"))
def warmup(args: argparse.Namespace) -> int:
    """Compile everything that readings, depth images, fleets and builds of designs need, and keep
    it on this machine. Run it once while an image of a container or a runner of tests is made, as
    the user and on the kind of processor that it will run with.

    examples:
      capsense warmup
      capsense warmup --quiet
    """
    logging.getLogger("capsense").setLevel(logging.ERROR)  # what is announced is what is done …
    if not args.quiet:  # … but for how many kernels there are so far
        logging.getLogger("capsense.kernels").setLevel(logging.WARNING)
    start = perf_counter()
    for name, run in stages():
        before = perf_counter()
        run()
        if not args.quiet:
            say(f"{name}: {perf_counter() - before:.1f} s")
    if not args.quiet:
        say(f"done in {perf_counter() - start:.0f} s")
    return OK


def stages() -> Iterator[Stage]:
    """What is compiled, in parts: their names, and what calls all of their kernels."""
    yield "readings", _readings
    yield "meshes, images and cloth", _surfaces
    yield "contact and covers", _contact
    yield "fleets", _fleets
    yield "builds of designs", _builds


def _body(height: float, **more: Any) -> Body:
    import capsense as cs

    return cs.Body(cs.Sphere(0.03), cs.Pose((0.0, 0.0, 0.03 + height)), **more)


def _readings() -> None:
    import capsense as cs

    simulator = cs.Simulator("six_patch")
    salt_water = cs.Material("salt water", eps_r=78.0, sigma=1.0)
    variants: tuple[dict[str, Any], ...] = (
        {}, {"grounding": "floating"}, {"material": "water"}, {"material": salt_water},
    )  # fmt: skip
    for more in variants:
        for height in (0.05, 2e-3):
            simulator.step(cs.Scene([_body(height, **more)]))
    pair = cs.Scene([
        cs.Body(cs.Box((0.1, 0.1, 0.002)), cs.Pose((0, 0, 0.02)), "steel", "floating"),
        cs.Body(cs.Box((0.1, 0.1, 0.002)), cs.Pose((0, 0, 0.0225)), "steel"),
    ])  # fmt: skip
    simulator.step(pair, jacobian=True)
    simulator.step_batch([pair, cs.Scene([_body(0.05)])])
    cs.Ellipsoid((0.02, 0.02, 0.03)).signed_distance([[0.0, 0.0, 0.1]])


def _surfaces() -> None:
    import numpy as np

    import capsense as cs

    simulator = cs.Simulator("six_patch")
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 40), np.linspace(-0.1, 0.1, 40), indexing="ij")
    n = np.arange(39 * 40).reshape(39, 40)[:, :-1].ravel()
    faces = np.concatenate([
        np.stack([n, n + 40, n + 41], axis=1), np.stack([n, n + 41, n + 1], axis=1)
    ])  # fmt: skip
    for height in (0.05, 1e-3):
        points = np.stack([x, y, height + 0.05 * (x**2 + y**2)], axis=-1).reshape(-1, 3)
        for material in ("steel", "water"):
            cloth = cs.DeformableSurface(points, faces, material=material)
            simulator.step(cs.Scene([cloth.body()]))
    simulator.step(cs.DepthFrame(np.full((48, 48), 0.2), 4.0, cs.OrthographicCamera()))
    a = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([0.05 * np.cos(a), 0.05 * np.sin(a)], axis=1)
    rings = [np.column_stack([ring, np.full(60, z)]) for z in np.linspace(0.0, 0.1, 30)]
    k, i = np.meshgrid(np.arange(29), np.arange(60), indexing="ij")
    low, high = (k * 60 + i).ravel(), (k * 60 + (i + 1) % 60).ravel()
    sides = np.concatenate([
        np.stack([low, high, high + 60], axis=1), np.stack([low, high + 60, low + 60], axis=1)
    ])  # fmt: skip
    tube = cs.TriMesh(np.concatenate(rings), sides)
    for height in (0.05, 2e-3):
        simulator.step(cs.Scene([cs.Body(tube, cs.Pose((0.0, 0.0, height)))]))


def _contact() -> None:
    import capsense as cs

    pad = cs.Simulator("dual_pad")
    pad.step(cs.Scene([_body(-2e-4)]))
    pad.step(cs.Scene([_body(0.0).pressed(2.0)]), jacobian=True)


def _fleets() -> None:
    import numpy as np

    import capsense as cs

    for design in ("six_patch", "dual_pad"):
        fleet = cs.Fleet(design, [_body(0.05)], 2)
        poses = np.tile([0.0, 0.0, 0.06, 1.0, 0.0, 0.0, 0.0], (2, 1, 1))
        fleet.step(poses)
        fleet.step(poses, jacobian=True)


def _builds() -> None:
    from capsense.design import parse_design
    from capsense.field.background import BuildSettings, build_background

    pad = {"name": "A", "shape": "disc", "radius": 0.01}
    layer = {"name": "board", "eps_r": 4.0, "size": [0.04, 0.04], "z": [-0.001, 0.0]}
    table = {
        "name": "warm-up",
        "domain": {"size": [0.2, 0.2, 0.2], "backplane": 0.01},
        "electrode": [pad],
        "layer": [layer],
    }
    build_background(parse_design(table), BuildSettings(panel_scale=8.0))
