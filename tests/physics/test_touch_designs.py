"""The packaged designs with a cover: proximity, pressure, and what a step says about touch."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from importlib import resources

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.design import parse_design
from capsense.errors import DesignError

NAMES = ("dual_pad", "fingertip12", "gripper_pad", "icub_triangle")
APPROACH = np.geomspace(0.2, 2e-5, 12)
"""Distances of a body from the face [m]."""
FIST = 0.04
"""Radius [m]."""

Pads = Callable[[str], cs.Simulator]


@pytest.fixture(scope="module")
def pads(simulators: Callable[..., cs.Simulator]) -> Pads:
    """A packaged design."""
    return lambda name: simulators(name)


def fist(sim: cs.Simulator, distance: float, force: float | None = None) -> cs.Scene:
    """A grounded ball over the middle of the cover, at a distance from its face [m]."""
    cover = sim.design.cover
    assert cover is not None
    x, y = 0.5 * (cover.lower + cover.upper)[:2]
    pose = cs.Pose((x, y, cover.upper[2] + FIST + distance))
    return cs.Scene([cs.Body(cs.Sphere(FIST), pose, "human", name="fist", force=force)])


def test_a_cover_lies_on_what_is_below_it() -> None:
    """The foam of the pad lies on its board, beside bars as high as itself."""
    design = cs.load_design("dual_pad")
    assert design.cover is not None
    assert (design.cover.lower[2], design.cover.upper[2]) == approx((0.0, 0.002))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": 0.001}, "nothing may be higher"),
        ({"center": [0.1, 0.0]}, "nothing lies below it"),
    ],
)
def test_misplaced_covers_are_refused(change: dict[str, object], message: str) -> None:
    """A cover lower than what is beside it, or over nothing."""
    text = (resources.files("capsense.design") / "library" / "dual_pad.toml").read_text()
    data = tomllib.loads(text)
    data["cover"][0].update(change)
    with pytest.raises(DesignError, match=message):
        parse_design(data)


@pytest.mark.parametrize("name", NAMES)
def test_reading_rises_from_afar_to_full_compression(name: str, pads: Pads) -> None:
    """Invariant: nearer, then deeper, no self-capacitance falls or is below that of emptiness.

    Electrodes under a grounded fabric sense nothing before contact; what they are off by then is
    under 1e-5 of their capacitance.
    """
    sim = pads(name)
    cover = sim.design.cover
    assert cover is not None
    depths = cover.thickness * np.linspace(0.0, 1.2, 13)
    change = np.array([np.diag(sim.step(fist(sim, d)).delta) for d in (*APPROACH, *-depths)])
    noise = 1e-5 * np.diag(sim.baseline)
    assert np.all(change > -noise)
    assert np.all(np.diff(change, axis=0) > -noise)
    assert np.all(change[-1] > 1e-15), "each electrode senses the fist in the end"
    assert np.isfinite(change).all()


@pytest.mark.parametrize("name", NAMES)
def test_touch_is_the_foundation_s(name: str, pads: Pads) -> None:
    """Closed form: a ball of radius R at depth d is carried by pi E R d² / t, and d is felt."""
    sim = pads(name)
    cover = sim.design.cover
    assert cover is not None
    assert sim.step(fist(sim, 1e-3)).touch.total == 0.0  # type: ignore[union-attr]
    modulus = cover.law.stress[-1] / cover.law.strain[-1]
    half = 0.5 * np.ptp([cover.lower, cover.upper], axis=0)[:2].min()
    depth = 0.5 * min(cover.thickness, half**2 / (2 * FIST))  # stays on the cover
    touch = sim.step(fist(sim, -depth)).touch
    assert touch is not None
    assert touch.total == approx(np.pi * modulus * FIST * depth**2 / cover.thickness, rel=0.02)
    assert 0.0 < touch.force.sum() <= touch.total * (1 + 1e-9)
    assert 0.5 * depth < touch.compression.max() <= depth * (1 + 1e-3)
    held = sim.step(fist(sim, 5e-3, force=touch.total)).touch
    assert held is not None
    assert held.total == approx(touch.total, rel=1e-6)
    np.testing.assert_allclose(held.compression, touch.compression, atol=0.06 * depth)


def test_dual_pad_tells_proximity_from_pressure(pads: Pads) -> None:
    """Left and right sense a fist, the electrode under the fabric its pressure."""
    sim = pads("dual_pad")
    left, press, right = np.diag(sim.step(fist(sim, 5e-3)).delta)
    assert min(left, right) > 10e-15
    assert abs(press) < 0.1e-15
    near, hard = (np.diag(sim.step(fist(sim, 0.0, force=f)).delta) for f in (0.1, 5.0))
    assert hard[1] > near[1] + 500e-15
    assert sim.step(fist(sim, 0.0, force=5.0)).touch.force[[0, 2]].max() == 0.0  # type: ignore[union-attr]


def test_forces_add_up_over_electrodes_smaller_than_a_contact(pads: Pads) -> None:
    """Known result: a plate on all of a cover presses each taxel by its area times the pressure."""
    sim = pads("icub_triangle")
    cover = sim.design.cover
    assert cover is not None
    depth, (x, y) = 0.5e-3, 0.5 * (cover.lower + cover.upper)[:2]
    plate = cs.Body(cs.Box((0.06, 0.06, 0.01)), cs.Pose((x, y, cover.upper[2] + 0.005 - depth)))
    touch = sim.step(cs.Scene([plate])).touch
    assert touch is not None
    want = 60e3 * depth / cover.thickness * np.pi * 0.0022**2
    np.testing.assert_allclose(touch.force, want, rtol=0.01)
    np.testing.assert_allclose(touch.compression, depth, rtol=1e-3)


def test_fabric_carries_compression_on(pads: Pads) -> None:
    """A taxel beside a contact senses it through the fabric, again and again alike."""
    sim = pads("icub_triangle")
    cover = sim.design.cover
    assert cover is not None
    tip = cs.Body(cs.Sphere(0.004), cs.Pose((0.0, 0.0, cover.upper[2] + 0.004 - 1e-3)))
    changes = [np.diag(sim.step(cs.Scene([tip])).delta) for _ in range(20)]
    np.testing.assert_array_equal(changes, [changes[0]] * 20)
    middle = sim.electrode_names.index("T4")
    assert changes[0].argmax() == middle
    others = np.delete(changes[0], middle)
    assert others.max() > 0.0
    assert others.max() < 0.3 * changes[0][middle]


def test_overlap_beyond_the_cover_is_no_contact_with_an_electrode(pads: Pads) -> None:
    """Physics engines press bodies through a cover; the reading stays one, with its estimate."""
    sim = pads("dual_pad")
    cover = sim.design.cover
    assert cover is not None
    reading = sim.step(fist(sim, -1.5 * cover.thickness))
    assert reading.stats.solver_error < 0.1 * np.abs(reading.delta).max()
