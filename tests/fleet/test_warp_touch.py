"""Covers on Warp: contact mechanics as of a fleet on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
from near_scenes import fleet_of, near_scenes

import capsense as cs
from capsense.fleet import Fleet, FleetTouch

pytest.importorskip("warp")


def touch_misses(found: FleetTouch, truth: FleetTouch) -> float:
    """Largest difference of any part of two touches, over the largest entry of each view."""
    out = 0.0
    for name in ("force", "compression", "total"):
        one, two = getattr(found, name).numpy(), getattr(truth, name)
        assert one.shape == two.shape
        axes = tuple(range(2, two.ndim))
        scale = np.maximum(np.abs(two).max(axis=axes, keepdims=True, initial=0.0), 1e-9)
        out = max(out, (np.abs(one - two) / scale).max())
    return float(out)


def test_overlaps_are_felt(foam_field: cs.Design) -> None:
    """Differential: all kinds of bodies up to past full compression; measured 2e-4."""
    some = Fleet(foam_field, [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 24, (-3e-3, 1e-3), "grounded", seed=3)
    truth = fleet_of(foam_field, scenes).step(scenes.poses).touch
    found = fleet_of(foam_field, scenes, device="warp:cpu", budget=32).step(scenes.poses).touch
    assert truth is not None
    assert (truth.total > 0.0).sum() > 12
    assert touch_misses(found, truth) < 1e-3
