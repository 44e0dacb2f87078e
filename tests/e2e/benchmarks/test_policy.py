"""The benchmark of policies: tiny trainings, and what its table tells of known returns."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from benchmark_modules import imported


@pytest.fixture(scope="module")
def policy() -> Iterator[Any]:
    """The benchmark's module."""
    pytest.importorskip("gymnasium", reason="Gymnasium is not installed")
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    with imported("policy") as found:
        yield found["policy"]


@pytest.mark.parametrize("kind", ["field", "distance"])
def test_a_tiny_training(kind: str, policy: Any, tmp_path: Path) -> None:
    """It learns, and keeps its curve and its policy; another length is trained anew."""
    sac = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed").SAC
    found = policy.train(kind, 1, 260, tmp_path)
    assert sum(np.diff([0, *found["steps"]])) == found["steps"][-1] <= 260
    assert len(found["returns"]) == len(found["steps"]) >= 1
    assert policy.train(kind, 1, 260, tmp_path) == found
    model = sac.load(tmp_path / f"{kind}-1.zip")
    assert model.num_timesteps == 260
    assert model._n_updates > 0
    action, _ = model.predict(np.zeros((3, *model.observation_space.shape)), deterministic=True)
    assert action.shape == (3, 5)
    if kind == "distance":  # the quicker one
        assert policy.train(kind, 1, 520, tmp_path)["steps"][-1] > 260


def test_the_distance_model_is_right_at_the_set_distance(policy: Any) -> None:
    """By definition: the sum of its changes 5 cm over a usual limb is the field's."""
    env = policy.DistanceFollow()
    env.reset(seed=3)
    plates = policy.DistanceModel(env.simulator.design, env.skin.scale)
    poses = policy.LimbPose(), policy.LimbPose(vertical=0.09)
    scenes = [policy.PoseEstimator(env.simulator).scene(p, policy.Belief().radius) for p in poses]
    near, far = (float(plates.read(scene).sum()) for scene in scenes)
    assert near == approx(env.simulator.step(scenes[0]).delta.trace(), rel=1e-12)
    assert far < near
    (reading,) = env.skin.read().values()
    assert np.all(np.diag(reading.delta) > 0)
    assert not (reading.delta - np.diag(np.diag(reading.delta))).any()


@pytest.mark.filterwarnings("ignore:Precision loss")  # SciPy's, of returns without spread
def test_the_table_of_known_returns(policy: Any) -> None:
    """By hand: equal episodes have no spread; trainings that differ have theirs."""

    def found(*returns: float) -> list[dict[str, list[float]]]:
        return [
            {"return": [r] * 4, "error": [1.0] * 4, "angle": [2.0] * 4, "lost": [0.0] * 4,
             "touched": [1.0, 0.0, 0.0, 0.0]} for r in returns
        ]  # fmt: skip

    results = {"trained on the field": found(200.0, 200.0),
               "trained on the distance": found(180.0, 190.0), "idle": found(90.0)}  # fmt: skip
    rows = policy.table(results).splitlines()[2:]
    assert rows == [
        "| trained on the field | 200.0 (200.0 to 200.0) | 200, 200 | 1.0 (1.0 to 1.0) | "
        "2.0 (2.0 to 2.0) | 0 of 8 | 2 of 8 |",
        "| trained on the distance | 185.0 (180.0 to 190.0) | 180, 190 | 1.0 (1.0 to 1.0) | "
        "2.0 (2.0 to 2.0) | 0 of 8 | 2 of 8 |",
        "| idle | 90.0 (90.0 to 90.0) |  | 1.0 (1.0 to 1.0) | 2.0 (2.0 to 2.0) | 0 of 4 | 1 of 4 |",
    ]
    # Student's t with one degree of freedom is Cauchy's: 15 ± 5 tan(0.475 π)
    assert policy.loss(results).endswith(": 15.0 (-48.5 to 78.5)\n")
    single = {name: some[:1] for name, some in results.items()}
    assert policy.loss(single).endswith(": 20.0\n")
