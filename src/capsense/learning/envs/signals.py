"""What a policy gets of capacitive sensors: numbers of fixed size, through their readouts.

:class:`CapacitiveObservation` adds them to MuJoCo environments that have none.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from capsense.adapters import mujoco as adapter
from capsense.errors import SceneError
from capsense.learning.chips import settled, settling
from capsense.learning.envs.scale import LIMIT, TARES, UNIT, compressed
from capsense.reading import Reading
from capsense.readout import SEED_STRIDE, Readout
from capsense.readout.config import make_readout
from capsense.scene import Pose
from capsense.simulator import DEFAULT_DESIGN
from capsense.skin import AnyDesign

KEY = "capacitive"
"""What the observation that is added is called."""
_OLDEST = 1.0
"""Ages are held below this [s]."""


class Signals:
    """The registers of the chips of several sensors.

    Args:
        readouts: The readout of each sensor, by name.
        normalise: Whether changes are within ±1, by
            :func:`~capsense.learning.envs.scale.compressed`.
    """

    def __init__(self, readouts: Mapping[str, Readout], normalise: bool = False) -> None:
        self.readouts, self.normalise = dict(readouts), normalise
        self.tare: dict[str, NDArray[np.float64]] = {}
        """Zero of every channel [F], by sensor."""
        self.felt: dict[str, NDArray[np.float64]] = {}
        """What was read last [10 fF], by sensor."""

    def reset(
        self, time: float, seed: int, tare: Mapping[str, Reading], now: Mapping[str, Reading]
    ) -> None:
        """Switch the chips on, with a scene at hand that is their zero, as anybody would do.

        The zero is the mean of :data:`TARES` conversions of each channel.

        Args:
            time: The simulator's time [s]; the chips have settled on the tare before it.
            seed: Of all noise.
            tare: Readings of that scene, by sensor.
            now: Readings of the scene that stands before the sensors from then on.
        """
        for number, (name, chip) in enumerate(self.readouts.items()):
            wait = settling(chip)
            begun = time - 3 * wait - TARES * chip.schedule.period
            chip.reset(start=begun, seed=seed + number * SEED_STRIDE)
            settled(chip, tare[name], begun)
            told = begun + wait + TARES * chip.schedule.period
            counts = chip.sample(told, tare[name])
            sums = np.bincount(counts.channel, counts.capacitance)
            self.tare[name] = sums / np.bincount(counts.channel)
            settled(chip, now[name], told)

    @property
    def names(self) -> tuple[str, ...]:
        """What the numbers of :meth:`read` are called."""
        return tuple(
            f"{name}.{channel}{what}"
            for name, chip in self.readouts.items()
            for what in ("", ".age")
            for channel in chip.channel_names
        )

    @property
    def limits(self) -> NDArray[np.float32]:
        """No number of :meth:`read` is further from zero than this, shape (size,)."""
        largest = 1.0 if self.normalise else LIMIT
        most = [_OLDEST if name.endswith(".age") else largest for name in self.names]
        return np.array(most, np.float32)

    def read(self, time: float, now: Mapping[str, Reading]) -> NDArray[np.float32]:
        """Of each sensor: change of every channel since the tare [10 fF], then their ages [s].

        Normalised changes are numbers within ±1.

        Args:
            time: The simulator's time [s].
            now: What the sensors read at it.
        """
        out = []
        for name, chip in self.readouts.items():
            held = chip.sample(time, now[name]).held()
            change = np.clip((held.capacitance - self.tare[name]) / UNIT, -LIMIT, LIMIT)
            self.felt[name] = change
            change = compressed(change) if self.normalise else change
            out += [change, np.minimum(held.age, _OLDEST)]
        return np.concatenate(out).astype(np.float32)


class CapacitiveObservation(gymnasium.ObservationWrapper, RecordConstructorArgs):
    """Adds what capacitive sensors feel to the observations of a MuJoCo environment.

    Observations become a dict: what there was under ``"observation"`` (a dict keeps its own
    keys), and under ``"capacitive"`` the numbers of
    :class:`Signals`, of the state that MuJoCo derived last, one of
    its time steps before the newest. Chips are tared on an empty domain at every reset. The
    environment itself goes the way that it would go without.

    Args:
        env: An environment with ``unwrapped.model`` and ``unwrapped.data`` of MuJoCo.
        sites: Sites that carry sensors; see :func:`write_model` where there are none.
        design: What :func:`capsense.adapters.mujoco.attach_skin` takes.
        readout: Name of the chip behind every sensor, a readout file, or a readout, of which every
            sensor has a copy.
        normalise: Whether changes of capacitance are within ±1, see
            :func:`~capsense.learning.envs.scale.compressed`.
        options: As for ``attach_skin``: ``materials``, ``grounding``, ``exclude`` and so on.

    Raises:
        TypeError: It is no MuJoCo environment.
        SceneError: It has no such site.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip or file.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        sites: Sequence[str],
        design: AnyDesign = DEFAULT_DESIGN,
        readout: Readout | str | Path = "fdc1004",
        normalise: bool = False,
        **options: Any,
    ) -> None:
        how = {"sites": sites, "design": design, "readout": readout, "normalise": normalise,
               **options}  # fmt: skip
        RecordConstructorArgs.__init__(self, **how)
        gymnasium.ObservationWrapper.__init__(self, env)
        self._how = how
        inner = env.unwrapped
        if not hasattr(inner, "model") or not hasattr(inner, "data"):
            raise TypeError(
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
        readout, normalise = how.pop("readout"), how.pop("normalise")
        self.skin = adapter.attach_skin(inner.model, inner.data, **how, threads=1)
        sensors = {} if readout is None else self.skin.sensors
        self.signals = Signals(
            {n: copy.deepcopy(make_readout(readout, s.simulator)) for n, s in sensors.items()},
            normalise,
        )


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
