"""A capacitive observation for MuJoCo environments that have none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.utils import RecordConstructorArgs

from capsense.adapters import mujoco as adapter
from capsense.errors import SceneError
from capsense.learning.envs.signals import Signals
from capsense.readout.config import make_readout
from capsense.scene import Pose
from capsense.skin import AnyDesign

__all__ = ["CapacitiveObservation", "write_model"]

KEY = "capacitive"
"""What the new observation is called."""


class CapacitiveObservation(gymnasium.ObservationWrapper, RecordConstructorArgs):
    """Adds what capacitive sensors feel to the observations of a MuJoCo environment.

    Observations become a dict: what there was under ``"observation"`` (a dict keeps its own
    keys), and under ``"capacitive"`` the numbers of
    :class:`~capsense.learning.envs.signals.Signals`, of the state that MuJoCo derived last, one of
    its time steps before the newest. Chips are tared on an empty domain at every reset. The
    environment itself goes the way that it would go without.

    Args:
        env: An environment with ``unwrapped.model`` and ``unwrapped.data`` of MuJoCo.
        sites: Sites that carry sensors; see :func:`write_model` where there are none.
        design: What :func:`capsense.adapters.mujoco.attach_skin` takes.
        readout: Name of the chip behind every sensor, or a readout file.
        options: As for ``attach_skin``: ``materials``, ``grounding``, ``exclude`` and so on.

    Raises:
        SceneError: It is no MuJoCo environment, or has no such site.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip or file.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        sites: Sequence[str],
        design: AnyDesign = "six_patch",
        readout: str | Path = "fdc1004",
        **options: Any,
    ) -> None:
        how = {"sites": sites, "design": design, "readout": readout, **options}
        RecordConstructorArgs.__init__(self, **how)
        gymnasium.ObservationWrapper.__init__(self, env)
        self._how = how
        inner = env.unwrapped
        if not hasattr(inner, "model") or not hasattr(inner, "data"):
            raise SceneError(
                f"env is a {type(inner).__name__}, which has no MuJoCo model and data; give a "
                "MuJoCo environment"
            )
        self._rng = np.random.default_rng()
        self._attach()
        own = env.observation_space
        before = dict(own.spaces) if isinstance(own, Dict) else {"observation": own}
        if KEY in before:
            raise SceneError(f"observations hold {KEY!r} already; name several sites at once")
        most = self.signals.limits
        self.observation_space = Dict(before | {KEY: Box(-most, most, dtype=np.float32)})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; a seed is that of the chips' noise as well."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        inner: Any = self.env.unwrapped
        if inner.model is not self._model:
            self._attach()
        empty = {name: sensor.simulator.empty for name, sensor in self.skin.sensors.items()}
        seed = int(self._rng.integers(2**31))
        self.signals.reset(inner.data.time, seed, empty, self.skin.read())
        return self.observation(observation), info

    def observation(self, observation: Any) -> dict[str, Any]:
        """What there was, and what the sensors feel."""
        inner: Any = self.env.unwrapped
        before = observation if isinstance(observation, dict) else {"observation": observation}
        return before | {KEY: self.signals.read(inner.data.time, self.skin.read())}

    def _attach(self) -> None:
        inner: Any = self.env.unwrapped
        self._model = inner.model
        how = self._how.copy()
        readout = how.pop("readout")
        self.skin = adapter.attach_skin(inner.model, inner.data, **how, threads=1)
        sensors = {} if readout is None else self.skin.sensors
        self.signals = Signals({n: make_readout(readout, s.simulator) for n, s in sensors.items()})


def write_model(env_id: str, body: str, pose: Pose, path: str | Path, name: str = "pad") -> str:
    """Write the model of one of Gymnasium's environments, with the site of a sensor on a body.

    ``gymnasium.make(env_id, xml_file=str(path))`` then makes the environment; Gymnasium wants the
    path to begin with ``/``, ``./`` or ``~``. MuJoCo writes numbers with six digits.

    Args:
        env_id: Its name, such as ``"Reacher-v5"``.
        body: Name of the body.
        pose: The sensor frame in the body's frame.
        path: The file, ``.xml``.
        name: Of the site.

    Returns:
        ``name``, as :class:`CapacitiveObservation` takes it.

    Raises:
        SceneError: It is no MuJoCo environment of Gymnasium's, has no such body, or has a site of
            this name.
    """
    plain = gymnasium.make(env_id)
    model = getattr(plain.unwrapped, "fullpath", None)
    plain.close()
    if model is None:
        raise SceneError(f"{env_id} has no model file; add a site to its model, and wrap it")
    spec = mujoco.MjSpec.from_file(model)
    for folder in ("meshdir", "texturedir"):
        setattr(spec, folder, str(Path(model).parent / getattr(spec, folder)))
    site = adapter.add_sensor(spec, body, pose, name)
    spec.compile()
    Path(path).write_text(spec.to_xml(), encoding="utf-8")
    return site
