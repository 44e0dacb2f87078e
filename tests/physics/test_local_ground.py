"""A local ground that floats, bodies tied to it, and which measurements know it.

Fields are rough (:mod:`tiny_field`): what is tested are laws that hold for any. Figures are in
``tests/e2e/solver/test_floating_ground.py``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tiny_field import SETTINGS, few_sources

import capsense as cs
from capsense.design import parse_design
from capsense.errors import DesignError, SceneError
from capsense.field.background import BackgroundField
from capsense.field.cache import cache_key, load_or_build
from capsense.scene import Ties

Array = np.ndarray
DATA = {
    "name": "pads over a plane",
    "domain": {"size": [0.4, 0.4, 0.4], "backplane": 0.2, "open": True},
    "electrode": [
        {"name": "A", "shape": "rectangle", "size": [0.03, 0.04], "center": [-0.02, 0.0]},
        {"name": "B", "shape": "rectangle", "size": [0.03, 0.03], "center": [0.02, 0.0]},
    ],
    "conductor": [
        {"name": "plane", "role": "ground", "shape": "rectangle", "size": [0.08, 0.06],
         "z": -0.004},
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> BackgroundField:
    design = parse_design({**DATA, "grounding": "floating"})
    with few_sources():
        return load_or_build(design, SETTINGS, cache_dir=tmp_path_factory.mktemp("field"))


def simulator(field: BackgroundField, grounding: str | float) -> cs.Simulator:
    design = parse_design({**DATA, "grounding": grounding})
    return cs.Simulator(design, settings=SETTINGS, background=field)


def hand(grounding: object = "grounded", z: float = 0.03, **more: object) -> cs.Body:
    return cs.Body(cs.Sphere(0.015), cs.Pose((0.005, 0.0, z)), grounding=grounding, **more)


def read(sim: cs.Simulator, *bodies: cs.Body) -> Array:
    return sim.step(cs.Scene(bodies)).capacitance


def test_the_field_does_not_depend_on_the_capacitance() -> None:
    """Invariant: one field serves all capacitances; designs differ all the same."""
    floating, tied, earthed = (
        parse_design({**DATA, "grounding": g}) for g in ("floating", 1e-11, "grounded")
    )
    assert cache_key(floating, SETTINGS) == cache_key(tied, SETTINGS)
    assert cache_key(floating, SETTINGS) != cache_key(earthed, SETTINGS)
    assert len({d.content_hash() for d in (floating, tied, earthed)}) == 3
    assert earthed.content_hash() == parse_design(DATA).content_hash()
    assert tied.with_grounding("grounded").content_hash() == earthed.content_hash()


def test_readings_rise_from_floating_to_earthed(field: BackgroundField) -> None:
    """Invariant: reciprocal, the more capacitance to earth the larger, up to the earthed matrix."""
    ties = ["floating", 1e-13, 1e-12, 1e-11, 1e-10, 1e-3]
    found = np.array([read(simulator(field, t), hand()) for t in ties])
    np.testing.assert_allclose(found, found.swapaxes(1, 2), rtol=0, atol=1e-20)
    for weights in np.random.default_rng(1).normal(size=(20, 2)):
        assert (np.diff(np.einsum("kij,i,j->k", found, weights, weights)) > 0).all()
    whole = simulator(field, "floating")
    change = whole._solver.solve(cs.Scene([hand()])).matrix[:2, :2]
    np.testing.assert_allclose(found[-1], field.capacitance[:2, :2] + change, rtol=1e-6)


def test_without_earth_nothing_is_grounded(field: BackgroundField) -> None:
    """Analytic: the board floats, and a large body floats or is at earth: far away it does not
    matter; near by, an earthed one takes up what a floating one cannot."""
    sim = simulator(field, "floating")
    near = [read(sim, hand(g))[0, 0] for g in ("floating", 1e-12, "grounded")]
    assert near[0] < near[1] < near[2]


@pytest.mark.parametrize("z", [0.03, 0.017])
@pytest.mark.parametrize("board", ["floating", 1e-12, 1e-3])
def test_ties_are_a_network(field: BackgroundField, z: float, board: str | float) -> None:
    """Differential: the body's own node, from readings at ground, floating and on 1 pF, joined by
    hand with the capacitances to earth and to the local ground; far from the sensor and near."""
    sim = simulator(field, board)

    def matrix(grounding: object) -> Array:
        return field.capacitance + sim._solver.solve(cs.Scene([hand(grounding, z)])).matrix

    grounded, floating, tied = matrix("grounded"), matrix("floating"), matrix(1e-12)
    spread = grounded - floating  # a aᵀ/M of the node's row a and its own M
    share = np.trace(tied - floating) / np.trace(spread)
    own = 1e-12 * (1 / share - 1)
    values, vectors = np.linalg.eigh(spread)
    row = -np.abs(vectors[:, -1]) * math.sqrt(own * values[-1])
    whole = np.block([[grounded, row[:, None]], [row[None], np.array([[own]])]])
    earth_tie = 0.0 if board == "floating" else float(board)
    for ties in (Ties(0.0, 2e-12), Ties(3e-12, 2e-12), Ties(1e-13, 1e-9), "local"):
        earth, local = (0.0, 1e-3) if ties == "local" else (ties.earth, ties.local)
        full = whole.copy()
        full[3, 3] += earth + local
        full[2, 2] += local
        full[2, 3] -= local
        full[3, 2] -= local
        # Potentials: electrodes against the board, the board, the body.
        free = np.array([[1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]).T
        ground = free.T @ full @ free + np.diag([earth_tie, 0.0])
        side = free.T @ full[:, :2]
        expected = full[:2, :2] - side.T @ np.linalg.solve(ground, side)
        found = read(sim, hand(ties, z))
        np.testing.assert_allclose(found, expected, rtol=2e-3 if z < 0.02 else 2e-4)


def test_where_the_ground_is_earth_ties_are_one(field: BackgroundField) -> None:
    """Analytic: on earth, the capacitance to the local ground is one to earth; and a link of the
    same robot is grounded."""
    plain = parse_design(DATA)
    with few_sources():
        sim = cs.Simulator(plain, settings=SETTINGS)
    np.testing.assert_array_equal(read(sim, hand("local")), read(sim, hand()))
    np.testing.assert_array_equal(read(sim, hand(Ties(1e-12, 2e-12))), read(sim, hand(3e-12)))
    np.testing.assert_array_equal(read(sim, hand(Ties(1e-12, math.inf))), read(sim, hand()))
    # the same with the plane as a terminal on a large capacitance, but for panels of the plane
    large = simulator(field, 1e-3)
    np.testing.assert_allclose(read(large, hand()), read(sim, hand()), rtol=0.05)


def test_a_link_of_the_robot_brings_it_nearer_to_earth(field: BackgroundField) -> None:
    """Invariant: a link adds its capacitance to earth, a floating one at the same place does not;
    one that touches what is earthed earths the board."""
    sim = simulator(field, "floating")
    shape, pose = cs.Box((0.02, 0.2, 0.02)), cs.Pose((0.1, 0.0, 0.02))
    link = {g: cs.Body(shape, pose, grounding=g) for g in ("local", "floating", "grounded")}
    found = {g: read(sim, hand(), body)[0, 0] for g, body in link.items()}
    assert found["local"] > found["floating"]
    touching = cs.Body(cs.Sphere(0.02), cs.Pose((0.1, 0.1, 0.02)), grounding="grounded")
    earthed = read(sim, hand(), link["local"], touching)
    np.testing.assert_allclose(
        earthed, read(simulator(field, 1e-3), hand(), link["local"], touching), rtol=1e-6
    )


@pytest.mark.parametrize("z", [0.03, 0.017])
def test_jacobians_know_the_ground(field: BackgroundField, z: float) -> None:
    """Differential: against central differences of the reading, for bodies tied to the local
    ground and beside such. Adjoints hold to some per cent, less for bodies behind others."""
    sim = simulator(field, 1e-12)
    bodies = [
        hand(Ties(1e-12, 2e-12), z),
        cs.Body(cs.Box((0.02, 0.02, 0.02)), cs.Pose((-0.05, 0.03, 0.05)), grounding="local"),
        cs.Body(cs.Sphere(0.01), cs.Pose((0.04, -0.03, 0.04))),
    ]
    found = sim.step(cs.Scene(bodies), jacobian=True).jacobian
    assert found is not None
    step = 2e-4
    for number, body in enumerate(bodies):
        for way in range(3):
            rows = []
            for sign in (1.0, -1.0):
                place = np.array(body.pose.position)
                place[way] += sign * step
                moved = [*bodies]
                moved[number] = body.moved(cs.Pose(place, body.pose.quaternion))
                rows.append(read(sim, *moved))
            slope = (rows[0] - rows[1]) / (2 * step)
            scale = np.abs(found[number]).max(axis=(0, 1, 2))
            np.testing.assert_allclose(found[number, ..., way], slope, atol=0.05 * scale)


def test_batches_and_fleets_know_the_ground(field: BackgroundField, tmp_path) -> None:
    """Differential: to the last bit for batches; a fleet on the CPU against a simulator."""
    sim = simulator(field, 1e-12)
    scenes = [cs.Scene([hand(g, z)]) for g in ("grounded", "local") for z in (0.02, 0.04)]
    for scene, reading in zip(scenes, sim.step_batch(scenes), strict=True):
        np.testing.assert_array_equal(reading.capacitance, sim.step(scene).capacitance)
    with few_sources(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("capsense.fleet.fleet.default_settings", lambda _: SETTINGS)
        patch.setenv("CAPSENSE_CACHE_DIR", str(tmp_path))
        fleet = cs.Fleet(sim.design, [hand()], 2)
        poses = np.array([[[0.005, 0, 0.02, 0, 0, 0, 1.0]], [[0.005, 0, 0.04, 0, 0, 0, 1.0]]])
        found = fleet.step(poses, jacobian=True)
        for row, scene in enumerate(scenes[:2]):
            alone = sim.step(scene, jacobian=True)
            np.testing.assert_allclose(found.capacitance[row, 0], alone.capacitance, rtol=1e-9)
            np.testing.assert_allclose(found.error[row, 0], alone.error, rtol=1e-6)
            np.testing.assert_allclose(
                found.jacobian[row, 0], alone.jacobian, atol=1e-6 * np.abs(alone.jacobian).max()
            )
        with pytest.raises(SceneError, match="fleets know no ties to a local ground"):
            fleet.change(0, hand("local"))
        with pytest.raises(ValueError, match="is not earthed, which device 'warp:cpu' does not"):
            cs.Fleet(sim.design, [hand()], 2, device="warp:cpu")


def test_a_chip_reads_against_the_local_ground(field: BackgroundField) -> None:
    """By hand: self, differential and two-terminal channels of a floating board; what an LCR meter
    that floats reads between pads does not depend on what the board's ground is tied to."""
    patterns = [
        *cs.Readout.preset("fdc1004", ("A", "B")).bank.patterns,
        *(replace(p) for p in _pairs()),
    ]
    told = {}
    for tie in ("floating", 1e-12):
        sim = simulator(field, tie)
        sim.use_readout(cs.Readout.preset("fdc1004", ("A", "B"), noise=False, patterns=patterns))
        reading = sim.step(cs.Scene([hand()]), time=0.0)
        assert sim.readout is not None
        told[tie] = sim.readout.channel_values(reading)
        c = reading.capacitance
        np.testing.assert_allclose(told[tie][:3], [c[0, 0], c[1, 1], c[0, 0] - c[1, 1]], rtol=1e-9)
    assert (told["floating"][:2] < told[1e-12][:2]).all()


def _pairs():
    from capsense.readout.channels import differential_patterns, two_terminal_patterns

    return (*differential_patterns(("A", "B")), *two_terminal_patterns(("A", "B")))


def test_recordings_keep_grounds_and_ties(field: BackgroundField, tmp_path) -> None:
    """Differential: to the last bit, of the design and of bodies."""
    sim = simulator(field, 1e-12)
    bodies = [
        hand(Ties(1e-10, 2e-11), name="person"),
        hand("local", 0.08, name="link"),
        hand(Ties(0.0, math.inf), 0.12, name="other link"),
    ]
    with cs.Recorder(tmp_path / "a.mcap", sim) as recorder:
        recorder.write(0.0, cs.Scene(bodies), sim.step(cs.Scene(bodies)))
    recording = cs.open_recording(tmp_path / "a.mcap")
    assert recording.session.design.ground_capacitance == 1e-12
    (step,) = recording.steps()
    for body in bodies:
        assert step.scene[body.name].grounding == body.grounding


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: parse_design({**DATA, "grounding": "earth"}), DesignError, 'give "grounded"'),
        (lambda: parse_design({**DATA, "grounding": 0.0}), DesignError, "grounding = 0.0; give"),
        (lambda: parse_design({**DATA, "grounding": 100}), DesignError, "grounding = 100; give"),
        (lambda: parse_design({**DATA, "grounding": True}), DesignError, "grounding = True; give"),
        (lambda: parse_design({**DATA, "grounding": "local"}), DesignError, "'local'; give"),
        (
            lambda: parse_design({
                **DATA, "grounding": "floating",
                "conductor": [{**DATA["conductor"][0], "name": "local ground"}],
            }),
            DesignError, "is named 'local ground'.*rename it",
        ),
        (lambda: Ties(-1e-12), SceneError, "earth is -1e-12 F"),
        (lambda: Ties(math.inf), SceneError, "earth is inf F; give 0 to 0.001 F"),
        (lambda: Ties(0.0, math.nan), SceneError, "local is nan F.*or math.inf"),
        (lambda: Ties(), SceneError, "both are 0 F"),
    ],
)  # fmt: skip
def test_wrong_grounds_are_refused(make, error, words) -> None:
    with pytest.raises(error, match=words):
        make()


def test_what_has_no_local_ground_is_refused(field: BackgroundField) -> None:
    lone = parse_design(
        {k: v for k, v in DATA.items() if k != "conductor"} | {"grounding": "floating"}
    )
    assert not lone.local_ground
    with few_sources():
        sim = cs.Simulator(lone, settings=SETTINGS)
    c = sim.background.capacitance
    expected = (c[0, 0] * c[1, 1] - c[0, 1] ** 2) / c.sum()
    np.testing.assert_allclose(sim.baseline, expected * np.array([[1, -1], [-1, 1]]), rtol=1e-9)
    with pytest.raises(SceneError, match="has no conductor; give the design a"):
        sim.step(cs.Scene([hand("local")]))
    salt = cs.Material("brine", 70.0, 1e-3)
    with pytest.raises(SceneError, match="beside matter with losses"):
        simulator(field, 1e-12).step(
            cs.Scene([hand("local"), hand(z=0.08).__class__(cs.Sphere(0.01), material=salt)])
        )
