"""A task whose right action depends on what is there, and not on its distance alone.

It needs no physics engine: one call of a :class:`~capsense.fleet.Fleet` reads all environments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from capsense._validate import as_whole, suggest
from capsense.errors import SceneError
from capsense.fleet import Fleet
from capsense.learning.envs.autoreset import autoreset_of, ended, seeds_of
from capsense.learning.envs.picture import draw_section
from capsense.learning.envs.scale import LIMIT, TARES, UNIT, compressed
from capsense.readout import Readout
from capsense.readout.channels import mutual_patterns, self_patterns
from capsense.readout.config import make_readout
from capsense.readout.conversions import Held
from capsense.readout.randomisation import Distribution, ReadoutRandomisation
from capsense.scene import Body, Capsule, Pose
from capsense.scene import Box as BoxShape
from capsense.simulator import PresetName

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

TARGETS = {
    "person grounded": 0.12, "person floating": 0.12, "metal grounded": 0.05,
    "metal floating": 0.015,
}  # fmt: skip
"""Class of what is there → the right gap [m]: keep off a person, wait before a fixture, reach for a
workpiece."""
STEP = 0.04
"""Time from one action to the next [s]."""
SPEED = 0.2
"""Largest speed along the normal of the sensor [m/s]."""
NEAREST, FURTHEST = 0.005, 0.15
"""Gaps are held within these [m]."""
COST = 0.05
"""Error of the gap that costs the whole reward of a step [m]."""
NEAR_ENOUGH = 0.01
"""Error of the gap at which the right place is reached [m]."""
SIZES = np.linspace(0.03, 0.05, 8)
"""Radii of limbs, and half widths of bars [m]; a few, as shapes that were met before cost less."""
LENGTH = 0.25
"""Of limbs, between the centres of their ends, and of bars [m]."""
PERSON = 100e-12
"""What ties a floating person to ground [F]."""
SHIFT, TURN = 0.02, 0.4
"""How far the middle is off to either side [m], and how far the body is turned [rad]."""
_AWAY = 50.0


def _bodies() -> dict[str, list[Body]]:
    out: dict[str, list[Body]] = {}
    for name in TARGETS:
        what, _, tie = name.partition(" ")
        for size in SIZES.tolist():
            if what == "person":
                limb = Capsule(size, LENGTH)
                body = Body(limb, Pose(), "human", "grounded" if tie == "grounded" else PERSON)
            else:
                bar = BoxShape((LENGTH, 2 * size, 2 * size))
                body = Body(bar, Pose(), "steel", "grounded" if tie == "grounded" else "floating")
            out.setdefault(name, []).append(body)
    return out


class WhoIsThereVector(VectorEnv[Floats, Floats, NDArray[Any]]):
    """A pad before a person or a piece of metal, grounded or floating, at a gap that is drawn.

    The six electrodes of ``six_patch`` are read one by one and in pairs. Action: velocity along
    the pad's normal [0.2 m/s], positive towards the body. Observations: changes of the 6 self and
    15 mutual channels since the tare [10 fF], the distance moved since the episode's beginning [m],
    and the last action. Reward of a step: ``1 - |e| / 5 cm``, at least -1, of the error e of the
    gap from the right one, :data:`TARGETS`. Episodes do not end early. Facts: ``gap`` and
    ``error`` [m], ``kind`` (number of the class in :data:`TARGETS`), ``success`` (an error below
    1 cm).

    Episodes depend on the seed; the noise of chips also on the environment's number.

    Args:
        num_envs: How many there are.
        max_episode_steps: Episodes are cut after so many steps; None for no limit.
        classes: Those that are drawn, all by default.
        gap: Range of the gap at the beginning [m].
        chip: A readout of six electrodes, a readout file, or the name of a chip.
        normalise: Whether changes of capacitance are within ±1, see
            :func:`~capsense.learning.envs.scale.compressed`.
        autoreset_mode: ``"NextStep"`` or ``"SameStep"``, as of Gymnasium.
        preset: How finely the solver resolves surfaces.
        device: As of a fleet.
        render_mode: None, or ``"rgb_array"``: a section of each environment.

    Raises:
        ValueError: ``num_envs`` is not a whole number from 1, or there is no such mode.
        SceneError: There is no such class, or the range of gaps is not one.
        ReadoutError: There is no such chip or file, or the file is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = None, *,
        classes: Sequence[str] = tuple(TARGETS), gap: tuple[float, float] = (0.03, 0.09),
        chip: Readout | str | Path = "sdr", normalise: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        preset: PresetName = "fast", device: str = "cpu", render_mode: str | None = None,
    ) -> None:  # fmt: skip
        if (as_whole(num_envs) or 0) < 1:
            raise ValueError(f"num_envs is {num_envs!r}; give a whole number from 1")
        for name in classes:
            if name not in TARGETS:
                raise SceneError(f"classes: no class {name!r}; {suggest(str(name), TARGETS)}")
        low, high = gap
        if not classes or not NEAREST <= low <= high <= FURTHEST:
            raise SceneError(
                f"classes are {tuple(classes)}, gap is {gap}; give at least one class, and two "
                f"gaps from {NEAREST} to {FURTHEST} m that do not fall"
            )
        self.num_envs, self._limit = int(num_envs), max_episode_steps
        self.classes, self._range, self.normalise = tuple(classes), gap, normalise
        self.render_mode = render_mode
        self._mode = autoreset_of(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self._mode}
        self._known, self._kinds = _bodies(), list(TARGETS)
        n = self.num_envs
        first = self._known[self.classes[0]][0]
        self.fleet = Fleet("six_patch", [first], n, device=device, preset=preset)
        """What reads the sensors."""
        names = self.fleet.electrode_names
        if isinstance(chip, str) and not chip.endswith(".toml"):
            patterns = (*self_patterns(names, shield=0.0), *mutual_patterns(names))
            chip = Readout.preset(chip, names, patterns=patterns)
        spread = ReadoutRandomisation(gain=Distribution("uniform", 0.95, 1.05))
        self.fleet.use_readout(make_readout(chip, self.fleet), randomisation=spread)
        self.channel_names: tuple[str, ...] = cast("Readout", self.fleet.readout).channel_names
        """Of what is observed first."""
        k = len(self.channel_names)
        most = np.full(k + 2, 1.0 if normalise else LIMIT, np.float32)
        most[k:] = FURTHEST, 1.0
        self.single_observation_space = Box(-most, most, dtype=np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)
        self._rngs = [np.random.default_rng() for _ in range(n)]
        self.kind, self.size = np.zeros(n, np.int64), np.zeros(n)
        """Number of the class, and radius or half width of the body [m]."""
        self.gap, self._begun_at = np.zeros(n), np.zeros(n)
        """Between the electrodes and the body [m]."""
        self.side, self._turn = np.zeros((n, 2)), np.zeros(n)
        """How far the body is off to the side [m], shape (n, 2)."""
        self._last, self._clock, self._tare = np.zeros(n), np.zeros(n), np.zeros((n, k))
        self._steps, self._over = np.zeros(n, np.int64), np.zeros(n, np.bool_)

    @property
    def target(self) -> Array:
        """The right gap of each environment [m]."""
        return np.array(list(TARGETS.values()))[self.kind]

    def bodies(self) -> list[Body]:
        """What is there, of each environment, where it is in the sensor's frame."""
        out = []
        for kind, size, seven in zip(self.kind, self.size, self._poses()[:, 0], strict=True):
            body = self._known[self._kinds[kind]][int(np.argmin(np.abs(SIZES - size)))]
            out.append(Body(body.shape, Pose(seven[:3], seven[3:]), body.material, body.grounding))
        return out

    def changes(self) -> Array:
        """Changes of the channels since the tare [F], shape (n, K), as the chips tell them."""
        return self._told(self._poses()) - self._tare

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:  # fmt: skip
        """Begin new episodes.

        Args:
            seed: Of the first environment, those of the others follow; or one for each.
            options: ``{"reset_mask": …}``: which environments begin, shape (num_envs,).

        Raises:
            SceneError: Another number of seeds, or a mask of another shape.
        """
        seeds, mask = seeds_of(seed, options, self.num_envs)
        for k in np.flatnonzero(mask).tolist():
            if seeds[k] is not None:
                self._rngs[k] = np.random.default_rng(seeds[k])
                self.fleet.reset([k], seed=int(self._rngs[k].integers(2**31)))
        self._begin(mask)
        return self._observed(), self._facts()

    def step(
        self, actions: Floats
    ) -> tuple[Floats, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One action for each environment.

        Raises:
            SceneError: Actions have another shape, or one is not finite.
        """
        asked = np.asarray(actions, dtype=float)
        if asked.shape != self.action_space.shape or not np.isfinite(asked).all():
            raise SceneError(
                f"actions have shape {asked.shape}; give {self.action_space.shape}, all finite"
            )
        new = self._over.copy()
        if new.any():
            self._begin(new)
        self._last = np.where(new, 0.0, np.clip(asked[:, 0], -1.0, 1.0))
        self.gap = np.clip(self.gap - SPEED * STEP * self._last, NEAREST, FURTHEST)
        self._clock[~new] += STEP
        self._steps[~new] += 1
        observation, facts = self._observed(), self._facts()
        reward = np.where(new, 0.0, np.maximum(-1.0, 1.0 - facts["error"] / COST))
        cut = ~new & (self._steps >= (self._limit or np.inf))
        over = np.zeros(self.num_envs, np.bool_)
        self._over = cut.copy()
        if cut.any() and self._mode == AutoresetMode.SAME_STEP:
            final = observation, facts
            self._begin(cut)
            observation, facts = self._observed(), self._facts()
            facts |= ended(cut, *final)
            self._over = over
        return observation, reward, over, cut, facts

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A section of each environment, shape (240, 320, 3)."""
        if self.render_mode is None:
            return None
        return tuple(
            draw_section(
                float(self.gap[k]), float(self.side[k, 1]), float(self.size[k]),
                self._kinds[self.kind[k]], float(self.target[k]),
            )
            for k in range(self.num_envs)
        )  # fmt: skip

    def _begin(self, mask: NDArray[np.bool_]) -> None:
        """Draw episodes, switch chips on with nothing there, and tare them."""
        rows = np.flatnonzero(mask)
        for k in rows.tolist():
            rng = self._rngs[k]
            self.kind[k] = self._kinds.index(self.classes[rng.integers(len(self.classes))])
            self.size[k] = SIZES[rng.integers(len(SIZES))]
            self.gap[k] = rng.uniform(*self._range)
            self.side[k], self._turn[k] = rng.uniform(-SHIFT, SHIFT, 2), rng.uniform(-TURN, TURN)
        number = np.argmin(np.abs(SIZES - self.size[rows, None]), axis=1)
        chosen = [
            self._known[self._kinds[kind]][n]
            for kind, n in zip(self.kind[rows], number.tolist(), strict=True)
        ]
        self.fleet.change(0, chosen, rows)
        self._begun_at[rows], self._last[rows] = self.gap[rows], 0.0
        self._steps[rows], self._over[rows], self._clock[rows] = 0, False, 0.0
        self.fleet.reset(rows)
        away, readout = self._poses(), cast("Readout", self.fleet.readout)
        away[..., 2] += _AWAY
        sums = np.zeros_like(self._tare)
        for _ in range(TARES):
            self._clock[rows] += readout.schedule.period
            sums += self._told(away)
        self._tare[rows] = sums[rows] / TARES
        self._told(self._poses())
        self._clock[rows] += readout.schedule.period

    def _poses(self) -> Array:
        """Of the bodies in the sensor's frame, shape (n, 1, 7)."""
        out = np.zeros((self.num_envs, 1, 7))
        out[:, 0, :2] = self.side
        out[:, 0, 2] = self.gap + self.size
        c, s = np.cos(0.5 * self._turn), np.sin(0.5 * self._turn)
        limb = np.array([name.startswith("person") for name in self._kinds])[self.kind]
        r = np.where(limb, math.sqrt(0.5), 0.0)  # a capsule's axis is z
        w = np.where(limb, math.sqrt(0.5), 1.0)
        out[:, 0, 3], out[:, 0, 4], out[:, 0, 5], out[:, 0, 6] = -s * r, c * r, s * w, c * w
        return out

    def _told(self, poses: Array) -> Array:
        """What the chips hold [F], shape (n, K)."""
        held = cast("Held", self.fleet.step(poses, time=self._clock).held)
        values = held.capacitance
        return np.asarray(values if isinstance(values, np.ndarray) else values.numpy())[:, 0]

    def _observed(self) -> Floats:
        felt = np.clip(np.nan_to_num(self.changes()) / UNIT, -LIMIT, LIMIT)
        if self.normalise:
            felt = compressed(felt)
        moved = np.clip(self._begun_at - self.gap, -FURTHEST, FURTHEST)
        return np.column_stack([felt, moved, self._last]).astype(np.float32)

    def _facts(self) -> dict[str, Any]:
        error = np.abs(self.gap - self.target)
        facts: dict[str, Any] = {
            "gap": self.gap.copy(), "error": error, "kind": self.kind.copy(),
            "success": error < NEAR_ENOUGH,
        }  # fmt: skip
        there = np.ones(self.num_envs, np.bool_)
        return facts | {f"_{name}": there for name in facts}


class WhoIsThere(gymnasium.Env[Floats, Floats]):
    """One of :class:`WhoIsThereVector`, which describes the task and its options."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        self.many = WhoIsThereVector(1, render_mode=render_mode, **options)
        """It, as one environment of its vectorised kind."""
        self.render_mode = render_mode
        self.observation_space = self.many.single_observation_space
        self.action_space = self.many.single_action_space

    @property
    def observation_names(self) -> tuple[str, ...]:
        """What the numbers of an observation are called."""
        return (*self.many.channel_names, "moved", "last action")

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the actions move."""
        return ("approach",)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode; ``options`` are not used."""
        super().reset(seed=seed)
        observation, facts = self.many.reset(seed=[seed])
        return observation[0], _of_one(facts)

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Move for 0.04 s.

        Raises:
            SceneError: The action has another shape, or is not finite.
        """
        observation, reward, over, cut, facts = self.many.step(np.asarray(action)[None])
        return observation[0], float(reward[0]), bool(over[0]), bool(cut[0]), _of_one(facts)

    def render(self) -> Any:
        """A section, shape (240, 320, 3)."""
        pictures = self.many.render()
        return None if pictures is None else pictures[0]


def _of_one(facts: dict[str, Any]) -> dict[str, Any]:
    return {name: value[0].item() for name, value in facts.items() if not name.startswith("_")}
