"""The field of a design: what its boundary elements tell, in stages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from approximate import approx
from tiny_field import SETTINGS, arrays, digest, few_sources, tiny_design

from capsense.field import background
from capsense.field.background import BuildSettings, MeshSettings, build_background
from capsense.field.boundary import Accuracy, BoundarySolution


@pytest.fixture(scope="module", autouse=True)
def rough() -> Iterator[None]:
    """How well charges are answered does not matter here, so that fields are built quickly."""
    with few_sources():
        yield


def test_a_field_is_that_of_its_boundary_elements() -> None:
    """Differential: mutual capacitances are the means of both ways."""
    design, told = tiny_design(), []
    field = build_background(design, SETTINGS, lambda stage, part: told.append((stage, part)))
    solution = BoundarySolution(design.in_units, Accuracy(SETTINGS.panel_scale))
    densities = solution.densities(np.eye(2))
    charges = design.unit * solution.terminal_charges(densities)
    np.testing.assert_array_equal(field.capacitance, field.capacitance.T)
    np.testing.assert_allclose(field.capacitance, 0.5 * (charges + charges.T), rtol=1e-12)
    assert field.terminals == ("A", "B")
    assert field.n_panels == len(densities)
    stages, parts = zip(*told, strict=True)
    assert list(parts) == sorted(parts)
    assert parts[0] == 0.0
    assert told[-1] == ("done", 1.0)
    assert set(background._STAGES) < set(stages)
    assert len(set(parts)) >= len(set(background._STAGES.values())) + 2


def test_settings_count_and_have_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invariant: finer panels are more; no settings are the default ones."""
    design = tiny_design()
    coarse, fine = (build_background(design, replace(SETTINGS, panel_scale=s)) for s in (16.0, 8.0))
    assert coarse.n_panels < fine.n_panels
    assert BuildSettings().panel_scale == 1.0
    monkeypatch.setattr(background, "BuildSettings", lambda: SETTINGS)
    assert digest(build_background(design)) == digest(fine)
    assert all(np.isfinite(values).all() for values in arrays(coarse).values())


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 3.0])
def test_refined_settings(factor: float) -> None:
    """Analytic: all spacings go with one over the factor; planes merge no farther than before."""
    plain = MeshSettings()
    for settings in (plain.refined(factor), BuildSettings().refined(factor).mesh):
        for name in ("edge", "growth", "far", "face", "growth_z", "far_z", "tall"):
            assert getattr(settings, name) == approx(getattr(plain, name) / factor)
        assert settings.merge == approx(plain.merge / max(factor, 1.0))
    assert BuildSettings(3.0).refined(factor).panel_scale == approx(3.0 / factor)
    assert plain.merge < plain.edge < 0.01 < plain.far
    assert 0.0 < plain.growth < 1.0
    assert 0.0 < plain.growth_z < 1.0
