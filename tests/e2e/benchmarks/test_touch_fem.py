"""References of pressed covers against closed forms, and the finite elements that compute them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from approximate import approx
from benchmark_modules import imported

from capsense.constants import EPS0
from capsense.design import parse_design

ROOT = Path(__file__).parents[3]
MODULES = ("touch_fem", "touch_reference")


@pytest.fixture(scope="module")
def parts() -> Iterator[dict[str, ModuleType]]:
    """The benchmark's modules."""
    with imported(*MODULES) as found:
        yield found


@pytest.fixture(scope="module")
def touch(parts: dict[str, ModuleType]) -> ModuleType:
    """The benchmark itself."""
    return parts["touch_fem"]


def case_of(touch: ModuleType, name: str) -> Any:
    return next(case for case in touch.CASES if case.name == name)


def by_strain(touch: ModuleType, name: str) -> dict[float, float]:
    """Self-capacitances [F] with the grounded body, from touch on."""
    thickness = case_of(touch, name).thickness
    return {round(s["depth"] / thickness, 6): s["grounded_fF"] * 1e-15
            for s in touch.known()[name]["states"] if s["depth"] >= 0}  # fmt: skip


def test_references_are_of_the_cases_in_the_script(touch: ModuleType) -> None:
    assert list(touch.known()) == [case.name for case in touch.CASES]
    for case in touch.CASES:
        row = touch.known()[case.name]
        for key, value in asdict(case).items():
            assert row[key] == (list(value) if isinstance(value, tuple) else value)
        np.testing.assert_allclose([s["depth"] for s in row["states"]], touch.depths(case))


def test_readings_rise_to_full_pressure_and_floating_bodies_stay_below(touch: ModuleType) -> None:
    for row in touch.known().values():
        values = np.array([[s["grounded_fF"], s["floating_fF"]] for s in row["states"]])
        least = 0.0 if row["fabric"] else 1e-4
        assert (np.diff(values, axis=0) > 0).all()
        assert (values - row["far_fF"] >= least * row["far_fF"]).all()
        assert (values[:, 1] <= values[:, 0]).all()
        errors = [row["far_error_fF"], *(s["error_fF"] for s in row["states"])]
        assert max(errors) < 3e-5 * row["far_fF"] * max(1.0, values.max() / row["far_fF"])
        assert row["round"] < 0.01


def test_flat_body_at_high_pressure_is_a_plate_capacitor(touch: ModuleType) -> None:
    """Slope from 60 to 70 %, where the field is uniform but for the rim, which adds some."""
    case, values = case_of(touch, "punch"), by_strain(touch, "punch")
    plate = EPS0 * case.eps_r * math.pi * case.radius**2 / case.thickness
    change = plate * (1 / 0.3 - 1 / 0.4)
    assert change < values[0.7] - values[0.6] < 1.05 * change


def test_fabric_counts_by_its_integral(touch: ModuleType) -> None:
    """The fabric hides the body until it is pressed in; then ε0 ε [1/length − 1/t] counts."""
    case, values = case_of(touch, "fabric"), by_strain(touch, "fabric")
    assert values[0.0] == approx(touch.known()["fabric"]["far_fF"] * 1e-15, rel=1e-4)
    errors = []
    for strain in (0.3, 0.5, 0.7):
        law = touch.local_changes(case, strain * case.thickness)
        errors.append(law["pressed up"] / (values[strain] - values[0.0]) - 1)
    assert errors[2] == approx(0.0, abs=0.03)
    assert 0 < errors[2] < errors[1] < errors[0]  # the rim's field is less than that of plates


def test_local_laws_of_a_flat_body_are_those_of_plates(touch: ModuleType) -> None:
    case = case_of(touch, "punch")
    t, area = case.thickness, math.pi * case.radius**2
    for law, change in touch.local_changes(case, 0.5 * t).items():
        assert change == approx(EPS0 * case.eps_r * area / t, rel=1e-9), law


@pytest.mark.parametrize("name", ["ball", "punch"])
def test_ways_are_those_to_the_outline(parts: dict[str, ModuleType], name: str) -> None:
    touch, reference = parts["touch_fem"], parts["touch_reference"]
    case, depth = case_of(touch, name), 0.2e-3
    low = case.thickness - depth
    outline = reference.ball(case.body_radius, low)
    if case.edge:
        outline = reference.punch(case.body_radius, case.length, case.edge, low)
    points = np.concatenate([[p.at(s) for s in np.linspace(*p.ends, 20001)] for p in outline])
    r = np.array([0.5e-3, 2e-3, 7.8e-3])
    ways = touch.ways(case, r, depth)
    for k, radius in enumerate(r):
        distance = np.hypot(points[:, 0] - radius, points[:, 1])
        nearest = points[distance.argmin()]
        assert ways.nearest[k] == approx(distance.min(), rel=1e-6)
        assert abs(math.atan2(nearest[0] - radius, nearest[1])) == approx(ways.angle[k], abs=2e-3)
        below = points[points[:, 1] < low + case.body_radius / 20 + 2 * case.edge]
        if not case.edge or radius < case.body_radius - case.edge:
            height = np.interp(radius, *points[: len(below)].T)
            assert ways.up[k] == approx(height, rel=1e-3) or radius > below[:, 0].max()


def test_scenes_place_the_body_over_designs_that_load(touch: ModuleType) -> None:
    for case in touch.CASES:
        for depth in (-1e-3, 0.0, 0.5 * case.thickness):
            data, (body,) = touch.scene(case, depth, "floating", hard=True)
            design = parse_design(data)
            assert design.electrode_names == ("E",)
            top = max(layer.upper[2] for layer in design.layers)
            half = case.length / 2 if case.edge else case.body_radius
            assert body.pose.position[2] - half == approx(top - depth, abs=1e-12)
        assert touch.scene(case, None)[1] == []
        (cover,) = touch.scene(case, None)[0]["cover"]
        assert cover["top"] == ("ground" if case.fabric else "none")


def test_cylinder_with_rounded_edges_is_closed_and_of_its_size(touch: ModuleType) -> None:
    case = case_of(touch, "punch")
    body = touch.shape(case)
    size = np.ptp(body.vertices, axis=0)
    np.testing.assert_allclose(size, [2 * case.body_radius] * 2 + [case.length], rtol=1e-9)
    lowest = body.vertices[body.vertices[:, 2] < -case.length / 2 + 1e-9]
    assert np.hypot(*lowest[:, :2].T).max() == approx(case.body_radius - case.edge)


@pytest.mark.parametrize("eps_r", [1.0, 3.0])
def test_finite_elements_give_a_disc_on_a_dielectric(
    parts: dict[str, ModuleType], eps_r: float
) -> None:
    """4 ε0 (1 + ε) a; walls 200 radii away add about a part in 300."""
    pytest.importorskip("ngsolve", reason='pip install "capsense[peers]"')
    reference = parts["touch_reference"]
    a, far = 1e-3, 0.2
    section = reference.Section(a, 0.99 * far, eps_r, extent=0.99 * far, domain=(far, -far, far))
    found = reference.solve(section, tolerance=1e-3)
    assert found.own == approx(4 * EPS0 * (1 + eps_r) * a, rel=6e-3)
    assert found.own > 4 * EPS0 * (1 + eps_r) * a
    assert found.error < 2e-3 * found.own


def test_finite_elements_give_a_ball_and_its_charge_by_a_small_disc(
    parts: dict[str, ModuleType],
) -> None:
    """4 π ε0 R, and −8 ε0 a R / d for a disc of radius a << R in the distance d."""
    pytest.importorskip("ngsolve", reason='pip install "capsense[peers]"')
    reference = parts["touch_reference"]
    a, radius, gap, far = 0.02e-3, 1e-3, 2e-3, 0.2
    outline = reference.ball(radius, gap)
    section = reference.Section(a, 0.0, outline=outline, extent=0.01, domain=(far, -far, far))
    found = reference.solve(section, tolerance=1e-3)
    assert found.body == approx(4 * math.pi * EPS0 * radius, rel=0.02)
    assert found.mutual == approx(-8 * EPS0 * a * radius / (gap + radius), rel=0.02)
    assert found.own - found.mutual**2 / found.body == found.floating
