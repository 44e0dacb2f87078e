"""The packaged designs hold the facts that their comments state, and load fast."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import shapely
from approximate import approx

from capsense.design import Design, Role, available_designs, load_design
from capsense.design.geometry import Facet

NAMES = ("meander", "patch", "six_patch", "six_patch_bare", "stripe", "three_stripes")


def centers(design: Design) -> np.ndarray:
    """Centres of the electrodes [mm], shape (M, 3)."""
    return np.array([e.surface.bounds.mean(axis=0) for e in design.electrodes]) * 1e3


def extents(design: Design) -> np.ndarray:
    """Extents of the electrodes [mm], shape (M, 3)."""
    return np.array([np.ptp(e.surface.bounds, axis=0) for e in design.electrodes]) * 1e3


def test_names() -> None:
    """Every packaged design is listed and carries its own name."""
    assert set(NAMES) <= set(available_designs())
    for name in available_designs():
        assert load_design(name).name == name


@pytest.mark.parametrize("name", NAMES)
def test_loads_the_same_again(name: str) -> None:
    """Loading twice gives the same content."""
    first = load_design(name)
    assert load_design(name).content_hash() == first.content_hash()
    assert first.domain.size == (0.5, 0.5, 0.5)
    assert first.description
    for item in (*first.electrodes, *first.conductors):
        for facet in item.surface.facets:
            assert facet.polygon.is_valid
            assert facet.polygon.exterior.is_ccw
            assert not any(hole.is_ccw for hole in facet.polygon.interiors)


def test_hash_tells_outlines_apart() -> None:
    """Invariant: any corner of any outline counts, where an outline begins and runs to does not."""
    first = load_design("six_patch")
    pad = first.electrodes[0]
    rings = [[(0, 0), (9, 0), (9, 5), (0, 5)], [(1, 1), (2, 1), (2, 2)], [(4, 1), (7, 1), (6, 3)]]

    def of(*rings: list[tuple[float, float]]) -> str:
        polygon = shapely.Polygon(rings[0], rings[1:])
        facet = Facet(shapely.transform(polygon, lambda p: 1e-3 * p), np.zeros(3), np.eye(3))
        electrode = replace(pad, surface=replace(pad.surface, facets=(facet,)))
        return replace(first, electrodes=(electrode, *first.electrodes[1:])).content_hash()

    whole = of(*rings)
    assert of(rings[0][2:] + rings[0][:2], rings[2][::-1], rings[1]) == whole
    for k, ring in enumerate(rings):
        for j, (x, y) in enumerate(ring):
            moved = [*ring[:j], (x + 0.1, y + 0.1), *ring[j + 1 :]]
            assert of(*rings[:k], moved, *rings[k + 1 :]) != whole
    assert of(*rings[:2]) != whole


def test_six_patch() -> None:
    """Six 30 mm squares in two rows, on polycarbonate."""
    design = load_design("six_patch")
    assert design.electrode_names == ("E1", "E2", "E3", "E4", "E5", "E6")
    want = [[x, y, 0.0] for y in (-25, 25) for x in (-38, 0, 38)]
    assert centers(design) == approx(np.array(want))
    assert extents(design) == approx(np.tile([30, 30, 0], (6, 1)))
    (plate,) = design.layers
    assert (plate.material, plate.eps_r) == ("polycarbonate", 2.9)
    assert plate.lower * 1e3 == approx([-57.5, -42.5, -1.0])
    assert plate.upper * 1e3 == approx([57.5, 42.5, 0.0])
    assert design.domain.backplane == 0.01
    bare = load_design("six_patch_bare")
    assert not bare.layers
    assert bare.content_hash() != design.content_hash()
    assert centers(bare) == approx(centers(design))


def test_boards() -> None:
    """Stripe, patch and meander: sizes, pitches and grounded copper of the published boards."""
    stripe, patch, meander = (load_design(n) for n in ("stripe", "patch", "meander"))
    assert extents(stripe) == approx(np.tile([5.6, 54.6, 0], (4, 1)), abs=1e-6)
    assert np.diff(centers(stripe)[:, 0]) == approx([9.8] * 3)
    assert extents(patch) == approx(np.tile([15.7, 15.7, 0], (4, 1)))
    assert sorted(set(centers(patch)[:, 0].round(6))) == [-15.0, 15.0]
    assert np.ptp(centers(patch)[:, 1]) == approx(25.1)
    whole = np.concatenate([e.surface.bounds for e in meander.electrodes]) * 1e3
    assert np.ptp(whole, axis=0) == approx([41.5, 41.0, 0], abs=0.3)
    for design, width in ((stripe, 65), (patch, 65), (meander, 63.5)):
        pour, back = design.conductors
        assert (pour.role, back.role) == (Role.GROUND, Role.GROUND)
        assert np.ptp(pour.surface.bounds, axis=0) * 1e3 == approx([width, 77, 0])
        assert back.surface.bounds[:, 2] == approx([-0.0016, -0.0016])
        assert back.surface.area == approx(width * 77e-6)
        (board,) = design.layers
        assert board.eps_r == 4.5


@pytest.mark.parametrize(("name", "gap"), [("stripe", 0.5), ("patch", 0.5), ("meander", 0.35)])
def test_gap_to_the_pour(name: str, gap: float) -> None:
    """The pour keeps its clearance to every electrode, and no more."""
    design = load_design(name)
    pieces = [f.polygon for f in design.conductors[0].surface.facets]
    for electrode in design.electrodes:
        near = min(p.distance(electrode.surface.facets[0].polygon) for p in pieces)
        assert near * 1e3 == approx(gap, abs=1e-4)


def test_meander_gap() -> None:
    """The two combs interleave with 0.35 mm everywhere."""
    a, b = (e.surface.facets[0].polygon for e in load_design("meander").electrodes)
    assert a.distance(b) * 1e3 == approx(0.35, abs=1e-6)


def test_three_stripes() -> None:
    """Three 100 × 20 mm stripes at 30 mm pitch, 2.5 mm above the floor."""
    design = load_design("three_stripes")
    assert design.domain.backplane == 0.0025
    assert extents(design) == approx(np.tile([100, 20, 0], (3, 1)))
    assert centers(design)[:, 1] == approx([-30, 0, 30])


def test_hash_and_imports_in_a_fresh_process() -> None:
    """The hash is stable across processes; loading a design imports no heavy package."""
    code = (
        "import sys; from capsense.design import load_design; "
        "h = load_design('meander').content_hash(); "
        "print(h, [m for m in ('scipy', 'trimesh', 'matplotlib', 'numba') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == f"{load_design('meander').content_hash()} []"
