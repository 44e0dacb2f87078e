"""The online lattice: storeys, joints, and what its links reproduce exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from field_cases import patches, rectangle

from capsense.constants import EPS0
from capsense.errors import FieldError
from capsense.field.lattice import FREE, WALL, Lattice, LatticeSettings, build_lattice
from capsense.field.planes import _pair_up, plan_axes, plan_storeys

DESIGN = patches(rectangle((-0.03, 0.0), (0.03, 0.05)), rectangle((0.035, 0.01), (0.04, 0.03)))
SETTINGS = (
    LatticeSettings(),
    LatticeSettings().refined(0.6),
    LatticeSettings().refined(1.3),
    replace(LatticeSettings(), storey=0.01, thinning=0.6),
)


@pytest.fixture(scope="module", params=SETTINGS, ids=range(len(SETTINGS)))
def lattice(request) -> Lattice:
    return build_lattice(DESIGN, request.param)


def links(lattice: Lattice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends and weights of all links, stand-ins taken home."""
    axis, a = np.nonzero(lattice.weights)
    return a, lattice.home[lattice.beyond(axis, a)], lattice.weights[axis, a]


def test_storeys_thin_out(lattice):
    assert len(lattice.storeys) > 1
    for lower, upper in zip(lattice.storeys, lattice.storeys[1:], strict=False):
        assert upper.shape[0] < lower.shape[0] or upper.shape[1] < lower.shape[1]
        np.testing.assert_array_equal(upper.axes[2][:2], lower.axes[2][-2:])
        for axis in range(2):
            ends = upper.faces[axis]
            assert np.isin(ends, lower.faces[axis]).all()
            inner = upper.axes[axis][1:-1]
            assert (inner > ends[:-1]).all()
            assert (inner < ends[1:]).all()


def test_every_node_is_one_kind(lattice):
    joints = lattice.joints
    assert lattice.unknown[joints.parent].all()
    assert not lattice.unknown[joints.ceiling].any()
    assert (lattice.owner[joints.ceiling] == FREE).all()
    assert (lattice.owner[joints.parent - 1] == WALL).all()
    linked = np.zeros(lattice.n_nodes, bool)
    a, b, _ = links(lattice)
    linked[a] = linked[b] = True
    assert linked[lattice.unknown].all()


def test_weights_are_positive(lattice):
    assert (lattice.weights >= 0).all()
    assert links(lattice)[2].min() > 0


@pytest.mark.parametrize("axis", range(3))
def test_linear_fields_are_exact(lattice, axis):
    """The flux of a linear potential is balanced at every unknown, across storeys as well."""
    a, b, w = links(lattice)
    value = lattice.points[:, axis].copy()
    flux = w * (value[a] - value[b])
    sums, passing = np.zeros(lattice.n_nodes), np.zeros(lattice.n_nodes)
    for end, sign in ((a, 1.0), (b, -1.0)):
        np.add.at(sums, end, sign * flux)
        np.add.at(passing, end, np.abs(flux))
    off = np.abs(sums / np.maximum(passing, 1e-300))[lattice.unknown]
    assert off.max() < 1e-9


@pytest.mark.parametrize("axis", range(3))
def test_energy_of_a_linear_field(lattice, axis):
    """A linear potential's energy is that of the field, ε E² V."""
    a, b, w = links(lattice)
    value = lattice.points[:, axis]
    energy = float((w * (value[a] - value[b]) ** 2).sum())
    assert energy == pytest.approx(EPS0 * float(np.prod(DESIGN.domain.size)), rel=1e-9)


def test_one_storey_on_request():
    settings = replace(LatticeSettings(), thinning=0.0)
    lattice = build_lattice(DESIGN, settings)
    assert len(lattice.storeys) == 1
    assert len(lattice.joints) == 0
    for planned, axis in zip(plan_axes(DESIGN, settings), lattice.storeys[0].axes, strict=True):
        np.testing.assert_array_equal(planned, axis)


@pytest.mark.parametrize("seed", range(30))
def test_pairs_cover_all_lines_once_and_keep_to_the_limit(seed):
    rng = np.random.default_rng(seed)
    faces = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, rng.integers(2, 20)))])
    limit = float(rng.uniform(0.2, 2.0))
    groups = _pair_up(faces, limit)
    assert [i for g in groups for i in g] == list(range(1, len(faces)))
    for g in groups:
        assert len(g) == 1 or (len(g) == 2 and faces[g[1]] - faces[g[0] - 1] <= limit)


@pytest.mark.parametrize("n", range(2, 12))
def test_pairs_of_even_lines_are_mirror_symmetric(n):
    faces = np.arange(n + 1.0)
    groups = _pair_up(faces, 2.0)
    mirrored = [[n + 1 - i for i in reversed(g)] for g in reversed(groups)]
    assert groups == mirrored


def test_merged_lines_keep_to_their_bounds():
    settings = LatticeSettings()
    top = max(b.surface.bounds[1, 2] for b in DESIGN.sheets)
    for plan in plan_storeys(DESIGN, settings)[1:]:
        limit = settings.thinning * (plan.axes[2][1] - top)
        for axis in range(2):
            for g, width in zip(plan.groups[axis], np.diff(plan.faces[axis]), strict=True):
                assert len(g) == 1 or width <= limit * (1 + 1e-12)


def test_values_on_another_grid(lattice):
    """Analytic: a cubic in each coordinate comes through the splines unchanged, across storeys."""

    def smooth(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0) * 10
        return np.stack([1 + x - y * z + x**3, z**3 + y**2 - x * y], axis=-1)

    grid = (np.linspace(-0.2, 0.2, 7), np.linspace(-0.25, 0.1, 5), np.linspace(0.0, 0.24, 9))
    got = lattice.on_grid(smooth(lattice.points), grid)
    wanted = smooth(np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1))
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-9)


def test_a_grid_beyond_the_domain_is_refused(lattice):
    grid = (np.linspace(-0.2, 0.3, 4), np.zeros(1), np.zeros(1))
    with pytest.raises(FieldError, match="axis x"):
        lattice.on_grid(lattice.points, grid)
