"""Which charge functions are chosen: scores against a slow twin, and what holds in a cut."""

from __future__ import annotations

import math

import numpy as np
import pytest
import surface_twin as twin
from approximate import approx
from solver_scenes import (
    BALL,
    BOX,
    NAMES,
    NONE,
    SOME,
    WIDTH,
    Array,
    Scene,
    apart,
    body,
    exact,
    packed_green,
    scenes,
)

from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.selection.evaluation_kernels import ClusterEvaluation
from capsense.solver.selection.score_kernels import score
from capsense.solver.selection.selection_kernels import ActiveTree, choose


def fill_scores(looks: ClusterEvaluation, row: int, scores: Array) -> None:
    """Fill in what was found from a row on, that of a body's first cluster."""
    rows = [row]
    while rows:
        row = rows.pop()
        scores[looks.node[row]] = looks.score[row]
        if looks.children[row] >= 0:
            rows += [looks.children[row], looks.children[row] + 1]


def cut_of(scene: Scene, threshold: float) -> tuple[ActiveTree, Array, Array]:
    """The cut, the scores with those that are inherited, and each body's first cluster."""
    bodies = scene.packed()
    first = np.concatenate([[0], np.cumsum(2 * bodies["n"] - 1)])
    green = packed_green()
    scores = np.full(first[-1], math.nan)
    looks, rows = score(bodies, green, threshold, np.empty(green.terminals))
    cut = choose(bodies, looks, rows, threshold, WIDTH, facing_of(bodies[:0]))
    for b, row in enumerate(rows[:-1]):
        fill_scores(looks, row, scores[first[b] : first[b + 1]])
    for o, (_, shape) in zip(first, scene, strict=False):
        children = shape.tree.children
        for k in np.flatnonzero(children[:, 0] >= 0):
            for part in children[k]:
                if not scores[o + part] >= 0:
                    scores[o + part] = twin.DECAY * scores[o + k] if children[part, 0] >= 0 else 0.0
    return cut, scores, first


@pytest.mark.parametrize("name", [n for n in NAMES if n != "two joined, floating"])
def test_scores(name: str) -> None:
    """Differential: what each function alone takes up, raised by the scores below it."""
    check_scores(scenes()[name])


@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_scores_of_a_body_on_a_capacitance_across_a_wall(scale: float) -> None:
    """Differential: its net charge costs the energy of the capacitance too."""
    wall = float(packed_green().active_bounds[1, 0])
    check_scores(Scene([body(BOX, (wall - 0.01, 0.0, 0.05), ground_elastance=20.0, scale=scale)]))


@pytest.mark.parametrize(("height", "scale"), [(0.05, 2.5), (0.25, 2.5), (0.25, 4.0)])
def test_scores_of_a_wide_body_without_net_charge_across_a_wall(
    height: float, scale: float
) -> None:
    """Differential: its large clusters are split only where it counts itself."""
    wall = float(packed_green().active_bounds[1, 0])
    wide = body(BOX, (wall - 0.01, 0.0, height), scale=scale, ground_elastance=NONE)
    check_scores(Scene([body(BALL, (0.0, 0.0, 0.05)), wide]))


def check_scores(scene: Scene) -> None:
    for threshold in (0.015, 0.1):
        _, found, first = cut_of(scene, threshold)
        wanted = twin.scores(scene.pieces, scene.trees, exact(), packed_green(), threshold)
        for b, each in enumerate(wanted):
            mine = found[first[b] : first[b + 1]]
            np.testing.assert_allclose(mine, each, rtol=2e-3, atol=2e-6 * found.max())


@pytest.mark.parametrize("name", NAMES)
def test_scores_and_fades_fall_downwards(name: str) -> None:
    """Invariant: a whole scores no less than its parts; wholes of what is used are used."""
    scene = scenes()[name]
    cut, scores, first = cut_of(scene, 0.05)
    for b, (_, shape) in enumerate(scene):
        children = shape.tree.children
        for k in np.flatnonzero(children[:, 0] >= 0):
            assert scores[first[b] + k] >= scores[first[b] + children[k]].max()
    assert ((cut.fade >= 0) & (cut.fade <= cut.parent_fade) & (cut.parent_fade <= 1)).all()
    places = {(b, k): a for a, (b, k) in enumerate(zip(cut.body, cut.node, strict=True))}
    for a, parts in enumerate(cut.children):
        if parts[0] < 0:
            assert cut.fade[a] == 0
            continue
        assert (parts > a).all()
        tree = scene[cut.body[a]][1].tree
        assert [places[cut.body[a], k] for k in tree.children[cut.node[a]]] == parts.tolist()
        assert (cut.parent_fade[parts] == cut.fade[a]).all()
        assert cut.charge_fraction[a] == approx(
            tree.charge[tree.children[cut.node[a], 0]] / tree.charge[cut.node[a]]
        )
        if cut.fade[a] == 0:  # split for the estimate only
            assert (cut.children[parts] < 0).all()
    x = np.log(scores[first[cut.body] + cut.node] / 0.05 + 1e-300) / math.log(WIDTH)
    x = np.clip(x, 0, 1)
    parted = cut.children[:, 0] >= 0
    wanted = np.minimum(x * x * (3 - 2 * x), cut.parent_fade)
    np.testing.assert_allclose(cut.fade[parted], wanted[parted], atol=1e-12)
    entered = np.clip(cut.parent_fade / 0.1, 0, 1)
    wanted = np.where(parted, 1 - entered * entered * (3 - 2 * entered), 1.0)
    np.testing.assert_allclose(cut.self_weight, wanted, atol=1e-12)
    np.testing.assert_array_equal(cut.active, np.flatnonzero(cut.self_weight > 0))
    np.testing.assert_array_equal(cut.active_index[cut.active], np.arange(len(cut.active)))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_steps_where_a_function_enters(name: str) -> None:
    """Invariant: ΔC does not step at thresholds at which a function is about to enter."""
    scene = scenes()[name]
    _, scores, _ = cut_of(scene, 0.1)
    for value in np.unique(scores)[::-1][1:20]:
        before, after = (scene.solved(value * (1 + t)).delta for t in (1e-7, -1e-7))
        assert apart(before, after) < 2e-5


@pytest.mark.parametrize("name", SOME)
def test_lower_thresholds_use_more(name: str) -> None:
    """Invariant: no function is given up as the threshold falls."""
    before: set[tuple[int, int]] = set()
    for threshold in np.geomspace(3.0, 1e-5, 25):
        cut, _, _ = cut_of(scenes()[name], threshold)
        used = {
            (int(b), int(k)) for b, k, t in zip(cut.body, cut.node, cut.fade, strict=True) if t > 0
        }
        assert before <= used
        before = used
    assert len(before) > 100
