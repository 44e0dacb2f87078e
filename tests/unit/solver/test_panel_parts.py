"""Parts of panels: where they lie, what they meet, and what they are for."""

from __future__ import annotations

import ctypes
import math
from functools import cache

import numpy as np
import pytest
from approximate import approx
from field_cases import assert_physical
from interpreted import ON, fewer, limit
from scipy.spatial.transform import Rotation
from surface_scenes import green_of

import capsense as cs
from capsense.scene import TriMesh
from capsense.solver.bodies.panels import SurfacePanels, panels_of
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.interaction.subpanel_kernels import add_parts
from capsense.solver.placement.placement_kernels import ActiveClusters, placed
from capsense.solver.placement.truncation_kernels import truncate_to_domain
from capsense.solver.selection.selection_kernels import ActiveTree, chosen
from capsense.solver.surface_solver import PRESETS
from capsense.solver.system.step import prepared
from capsense.solver.tree.mean_kernels import means_between
from capsense.solver.tree.rigid import BODY, RigidShape, rigid_shape
from capsense.solver.tree.shape_cache import functions_of
from capsense.solver.tree.subpanels import RefinedShape, refined

Array = np.ndarray
LIMB, BLOCK = cs.Capsule(0.04, 0.1), cs.Box((0.08, 0.06, 0.03))
TURN = Rotation.from_euler("ZY", (0.4, math.pi / 2)).as_quat()


@cache
def shape_of(shape: cs.Shape, finest: float = 4e-3) -> RefinedShape:
    found = refined(rigid_shape(panels_of(shape, fewer(200)), apart=True), finest, shape)
    assert isinstance(found, RefinedShape)
    return found


def tetrahedron() -> TriMesh:
    corners = 0.05 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return TriMesh(corners, faces)


# ---- where they lie ----


@pytest.mark.parametrize("shape", [LIMB, BLOCK, tetrahedron()], ids=["limb", "block", "mesh"])
def test_parts_make_up_their_wholes(shape: cs.Shape) -> None:
    """Invariant: charges, centres and second moments of each panel and part are those of its two
    parts together, along the panel; those of panels as they were."""
    made = shape_of(shape)
    arrays, tree, m = made._parts, made.tree, len(made.panels)
    children, charge, center = arrays["children"], arrays["charge"], arrays["center"]
    stored = 2 * m - 1
    for name in ("charge", "center", "points", "extent", "softening_length"):
        np.testing.assert_array_equal(arrays[name][:stored], getattr(tree, name))
    inner = np.flatnonzero(children[:, 0] >= 0)
    assert len(inner) == len(children) // 2
    assert sorted(children[inner].ravel()) == list(range(1, len(children)))
    np.testing.assert_array_equal(children[inner, 1], children[inner, 0] + 1)
    assert (children[inner, 0] > inner).all()
    assert sorted(arrays["function"][inner]) == list(range(1, len(children) // 2 + 1))
    assert (arrays["function"][children[:, 0] < 0] == -1).all()
    arms = arrays["points"] - center[:, None]
    second = np.einsum("kqi,kqj->kij", arms, arms) / 4
    panels = np.flatnonzero(tree.panel >= 0)
    second[panels] = made.panels.moments[tree.panel[panels]]
    cut = inner[children[inner, 0] >= stored]
    assert set(cut) > set(panels[children[panels, 0] >= 0])
    normal = normals_of(made)
    for k in cut:
        share, along = charge[children[k]] / charge[k], np.eye(3) - np.outer(normal[k], normal[k])
        assert share.sum() == approx(1.0, abs=1e-12)
        off = (center[children[k]] - center[k]) @ along
        np.testing.assert_allclose(share @ off, 0.0, atol=1e-12)
        below = along @ second[children[k]] @ along + off[:, :, None] * off[:, None]
        whole = np.einsum("p,pij->ij", share, below)
        np.testing.assert_allclose(whole, along @ second[k] @ along, atol=1e-12)


def normals_of(shape: RefinedShape) -> Array:
    """Normal of the panel that each part lies in, and of panels; zero for other clusters."""
    children = shape._parts["children"]
    out = np.zeros((len(children), 3))
    for k in range(len(children)):
        if k < len(shape.tree.panel) and shape.tree.panel[k] >= 0:
            out[k] = shape.panels.normals[shape.tree.panel[k]]
        if children[k, 0] >= 0 and out[k].any():
            out[children[k]] = out[k]
    return out


ROUND = [LIMB, cs.Sphere(0.05), cs.Cylinder(0.04, 0.1), cs.Ellipsoid((0.05, 0.04, 0.03))]


@pytest.mark.parametrize("shape", ROUND, ids=repr)
def test_parts_of_round_shapes_lie_on_them(shape: cs.Shape) -> None:
    """Invariant: their points do, to a twentieth of how far the panels are off."""
    made = shape_of(shape)
    stored, points = 2 * len(made.panels) - 1, made._parts["points"]
    corners = made.panels.corners.reshape(-1, 3)
    off = np.abs(shape.signed_distance(points[stored:].reshape(-1, 3))).max()
    assert off < limit(0.05, 0.15) * np.abs(shape.signed_distance(corners)).max()
    centers = made._parts["center"][stored:]
    np.testing.assert_allclose(centers, points[stored:].mean(axis=1), atol=1e-15)


def test_parts_of_flat_shapes_stay_in_their_panels() -> None:
    """Invariant: nothing is moved but by rounding; nor are parts of a mesh, which is its panels."""
    for shape in (BLOCK, tetrahedron()):
        made = shape_of(shape)
        stored, arms = 2 * len(made.panels) - 1, made._parts["points"]
        arms = (arms - arms.mean(axis=1)[:, None])[stored:]
        normal = normals_of(made)[stored:]
        np.testing.assert_allclose(np.einsum("kqi,ki->kq", arms, normal), 0.0, atol=1e-15)


def longer_side(panels: SurfacePanels) -> Array:
    sides = np.linalg.norm(np.roll(panels.corners, -1, axis=1) - panels.corners, axis=2)
    return 0.5 * (sides[:, :2] + sides[:, 2:]).max(axis=1)


def test_parts_are_as_small_as_asked_for() -> None:
    """Invariant: no longer than that, or a part in 32 of their panel; none where panels are."""
    made = shape_of(BLOCK)
    arrays, panels = made._parts, np.flatnonzero(made.tree.panel >= 0)
    halvings = np.zeros(len(arrays["children"]), int)
    for k in np.flatnonzero(arrays["children"][:, 0] >= 0):
        if k in panels or halvings[k] > 0:
            halvings[arrays["children"][k]] = halvings[k] + 1
    end = arrays["children"][:, 0] < 0
    assert 3 <= halvings[end].max() <= 5
    assert (arrays["extent"][end & (halvings < 5)] <= 4e-3).all()
    assert (arrays["extent"][~end & (halvings > 0)] > 4e-3).all()
    whole = rigid_shape(panels_of(BLOCK, fewer(200)), apart=True)
    longest = float(longer_side(whole.panels).max())
    assert refined(whole, 1.001 * longest, BLOCK) is whole
    assert refined(whole, 0.999 * longest, BLOCK) is not whole


@pytest.mark.skipif(ON, reason="counts panels")
def test_conductors_have_parts() -> None:
    """Unit: not dielectrics, small bodies or wide ones, and not for learning; made once a size."""
    finest = PRESETS["standard"].finest
    assert PRESETS["fast"].finest is None
    for shape, conducting, wanted in (
        (LIMB, True, True), (LIMB, False, False), (cs.Sphere(0.01), True, False),
    ):  # fmt: skip
        found, size = functions_of(shape, 700, conducting=conducting, finest=finest)
        assert isinstance(found, RefinedShape) == wanted
        if isinstance(found, RefinedShape):
            assert found.finest * size == approx(0.85 * finest, rel=0.18)
            other = cs.Capsule(*(1.1 * np.array([shape.radius, shape.length])))
            again = functions_of(other, 700, conducting=True, finest=finest)[0]
            assert again.potential_coefficients is found.potential_coefficients
    assert type(functions_of(LIMB, 700, conducting=True)[0]) is RigidShape


# ---- what they meet ----


def pack(shape: RefinedShape, gap: float, eps_r: float = math.inf) -> Array:
    out = np.array([shape.record], BODY)
    out["scale"], out["rotation"] = 1.0, Rotation.from_quat(TURN).as_matrix()
    out["position"] = 0.004, 0.003, gap + 0.04
    out["inverse_susceptibility"] = 1.0 / (eps_r - 1.0)
    return out


def cut_of(bodies: Array) -> tuple[ActiveTree, ActiveClusters]:
    green = green_of()
    cut = chosen(bodies, green, 0.015, 2.5, facing_of(bodies[:0]))
    return truncate_to_domain(cut, placed(bodies, cut, green))


@pytest.mark.parametrize(("gap", "eps_r"), [(0.5e-3, math.inf), (2e-3, math.inf), (1e-3, 5.0)])
def test_means_of_parts(gap: float, eps_r: float) -> None:
    """Differential: means of 1/r between leaves, less those of whole panels, taken one by one."""
    shape = shape_of(LIMB)
    bodies = pack(shape, gap, eps_r)
    cut, leaves = cut_of(bodies)
    n, stored, node = len(cut.active), 2 * len(shape.panels) - 1, cut.node[cut.active]
    found = np.zeros((n, n), np.float32)
    add_parts(bodies, cut, leaves, found)
    parents = np.full(len(shape._parts["children"]), -1)
    inner = np.flatnonzero(shape._parts["children"][:, 0] >= 0)
    parents[shape._parts["children"][inner]] = inner[:, None]
    panel = node.copy()
    while (panel >= stored).any():
        panel[panel >= stored] = parents[panel[panel >= stored]]
    part = node >= stored
    assert part.sum() > (4 if ON else 20)
    weight = np.array([share_of(cut, a) for a in cut.active])
    means = means_between(leaves.true).astype(float)
    wanted = np.zeros((n, n))
    for i in np.flatnonzero(part):
        mine = part & (panel == panel[i])
        p = weight[mine] / weight[mine].sum()
        for j in range(n):
            theirs = (part & (panel == panel[j])) if part[j] else np.arange(n) == j
            q = weight[theirs] / weight[theirs].sum()
            value = means[i, j] - p @ means[np.ix_(mine, theirs)] @ q
            wanted[i, j] = wanted[j, i] = (1 + 2 * bodies["inverse_susceptibility"][0]) * value
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())


def share_of(cut: ActiveTree, leaf: int) -> float:
    """Share of a cluster that is a leaf in the charge of the body."""
    share, a = float(cut.self_weight[leaf]), leaf
    while a > 0:
        above = int(np.flatnonzero((cut.children == a).any(axis=1))[0])
        share *= cut.child_weights[above][list(cut.children[above]).index(a)]
        a = above
    return share


def halvings_of(shape: RefinedShape, gap: float) -> int:
    """How often panels are halved by functions that count."""
    cut = cut_of(pack(shape, gap))[0]
    depth = np.full(len(cut.node), -1)
    for a in range(len(cut.node)):
        if cut.children[a, 0] >= 0:
            is_panel = cut.node[cut.children[a, 0]] >= 2 * len(shape.panels) - 1 and depth[a] < 0
            depth[a] = 0 if is_panel else depth[a]
            depth[cut.children[a]] = depth[a] + 1 if depth[a] >= 0 else -1
    return int((depth[cut.fade > 0] + 1).max(initial=0))


def test_nearer_bodies_have_smaller_parts() -> None:
    """Invariant: none far away, then parts, then parts of parts."""
    shape = shape_of(LIMB)
    found = [halvings_of(shape, gap) for gap in (0.06, 2e-3, 2e-4)]
    assert found[0] == 0 or ON  # panels are wide then
    assert found == sorted(found)
    assert found[-1] >= 3


def test_wholes_have_the_energies_that_are_stored() -> None:
    """Invariant: parts change nothing of the energies that functions of whole panels have within
    the body, but for single precision."""
    shape = shape_of(LIMB)
    bodies = pack(shape, 1e-3)
    none = facing_of(bodies[:0])
    cut, leaves, functions, system = prepared(bodies, green_of(), 0.015, 2.5, none, bodies)
    pairs = np.zeros((len(leaves.extent),) * 2, np.float32)
    add_parts(bodies, cut, leaves, pairs)
    columns = np.zeros((len(leaves.extent), functions.solved))
    for f in range(functions.solved):
        charge = np.zeros(len(cut.node))
        a = functions.cluster[f]
        if functions.net[f]:
            charge[a] = 1.0
        else:
            charge[cut.children[a]] = 1.0, -1.0
        for c in range(len(charge)):
            if cut.children[c, 0] >= 0:
                charge[cut.children[c]] += cut.child_weights[c] * charge[c]
        columns[:, f] = (cut.self_weight * charge)[cut.active]
    added = columns.T @ pairs @ columns
    whole = functions.number[: functions.solved] < len(shape.panels)
    assert (~whole).sum() > (1 if ON else 5)
    size = np.sqrt(np.diag(system.matrix))[whole]
    assert np.abs(added[np.ix_(whole, whole)] / np.outer(size, size)).max() < 1e-5
    assert (np.diag(added)[~whole] > 0.0).all()


def test_addresses_stay_with_the_shape() -> None:
    """Unit: records point to arrays that the shape holds."""
    shape = shape_of(LIMB)
    record, arrays = shape.record, shape._parts
    assert record["n_panel_clusters"] == 2 * len(shape.panels) - 1
    assert 2 * record["n"] - 1 == len(arrays["children"])
    assert record["n_tabulated"] == len(shape.panels)
    found = ctypes.cast(int(record["charge"]), ctypes.POINTER(ctypes.c_double))
    np.testing.assert_array_equal([found[k] for k in (0, 5)], arrays["charge"][[0, 5]])
    assert shape.nbytes > shape.whole.nbytes


# ---- what they are for ----


@pytest.mark.skipif(ON, reason="takes long")
def test_parts_come_smoothly() -> None:
    """Invariant: where parts come in, in steps of 0.05 mm, a reading grows, by no jump of 1 %."""
    sim = cs.Simulator("six_patch_bare")
    limb = cs.Body(cs.Capsule(0.04, 0.25), cs.Pose((0.0, 0.0, 0.1), tuple(TURN)), "steel")
    gaps = np.arange(8e-3, 0.8e-3, -5e-5)
    read = []
    for gap in gaps:
        reading = sim.step(cs.Scene([limb.moved(cs.Pose((0.004, 0.003, 0.04 + gap), tuple(TURN)))]))
        read.append(np.diag(reading.delta))
    assert_physical(sim.baseline + reading.delta)
    change = np.diff(np.log(np.array(read)), axis=0)
    large = read[-1] > 0.03 * read[-1].max()
    assert change[:, large].min() > 0.0
    assert np.abs(np.diff(change[:, large], axis=0)).max() < 0.01


@pytest.mark.skipif(ON, reason="takes long")
def test_parts_that_hardly_come_in() -> None:
    """Regression: where parts stood for less of their panel than rounding leaves, nothing did."""
    sim = cs.Simulator("six_patch_bare", preset="fine")
    box = cs.Body(cs.Box((0.04, 0.04, 0.02)), cs.Pose((0.004, 0.003, 0.01 + 2e-5)), "steel")
    with pytest.warns(UserWarning, match="touch"):
        delta = sim.step(cs.Scene([box])).delta
    assert_physical(sim.baseline + delta)
