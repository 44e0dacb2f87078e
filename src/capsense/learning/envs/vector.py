"""Environments side by side, whose sensors are all read by one call of a :class:`cs.Fleet`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from capsense._validate import as_whole
from capsense.adapters.mujoco_depth import find_site
from capsense.adapters.mujoco_model import ModelReader
from capsense.adapters.rules import Rules
from capsense.adapters.world import Solid
from capsense.errors import SceneError
from capsense.fleet import Fleet
from capsense.learning.envs.autoreset import autoreset_of, ended, seeds_of
from capsense.learning.envs.base import CapacitiveEnv
from capsense.learning.envs.tasks import ApproachStop, Dressing, LimbFollow
from capsense.reading import Reading, StepStats
from capsense.scene import Body, Pose, Shape

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FAR = 100.0
"""Bodies of worlds that are not asked are moved so far away [m]: out of sight they cost nothing."""
_LAST = [1, 2, 3, 0]
"""Quaternions of MuJoCo as (x, y, z, w)."""


class FleetSkin:
    """Reads the sensors of several worlds of one kind by a fleet.

    Readings are those of the worlds' own sensors, but a person who touches the robot stays a
    conductor of its own; on Warp, bodies are cut into 64 clusters each. See
    :class:`~capsense.fleet.Fleet`.

    Args:
        worlds: The worlds; their models hold the same geoms, of sizes of their own.
        device: As of a fleet.

    Raises:
        ValueError: There is no such device.
        MissingDependencyError: Warp is asked for and not installed.
    """

    def __init__(self, worlds: Sequence[CapacitiveEnv], device: str) -> None:
        self._worlds, first = worlds, worlds[0]
        model, simulator = first.model, first.simulator
        self._names, self._empty = simulator.electrode_names, simulator.empty
        sites = [find_site(model, name) for name in first.sites]
        own = [int(model.site_bodyid[site]) for site in sites]
        solids = _solids(first)
        self._places = len(solids)
        self._fleet = Fleet(
            simulator.design, _bodies(solids), len(worlds), sensors=len(sites),
            device=device, preset=simulator.preset,
            excitation_frequency=simulator.excitation_frequency,
        )  # fmt: skip
        for k, carrier in enumerate(own):
            self._fleet.hide(k, [p for p, solid in enumerate(solids) if solid.frame == carrier])
        tied = {s.tie.owner for s in solids if not isinstance(s.tie.grounding, str)}
        for owner in tied:
            self._fleet.join([p for p, solid in enumerate(solids) if solid.tie.owner == owner])
        self._frames = np.array([solid.frame for solid in solids] + own)
        at = [Pose(model.site_pos[s], model.site_quat[s][_LAST]) for s in sites]
        local = [_seven(p) for p in (*(solid.pose for solid in solids), *at)]
        self._local = np.tile(np.array(local), (len(worlds), 1, 1))

    def take(self, numbers: Sequence[int]) -> None:
        """Take over worlds whose models were built anew.

        Raises:
            SceneError: One holds another number of bodies.
        """
        found = [_solids(self._worlds[n]) for n in numbers]
        for solids in found:
            if len(solids) != self._places:
                raise SceneError(
                    f"a world has {len(solids)} bodies, another {self._places}; worlds that step "
                    "together must have as many"
                )
        bodies = [_bodies(solids) for solids in found]
        for place in range(self._places):
            self._fleet.change(place, [each[place] for each in bodies], numbers)
        for number, solids in zip(numbers, found, strict=True):
            self._local[number, : self._places] = [_seven(solid.pose) for solid in solids]

    def read(self, numbers: Sequence[int]) -> list[dict[str, Reading]]:
        """The readings of some worlds as they are now, of each by sensor.

        Raises:
            SolveError: A world has no solution.
        """
        poses = self._local.copy()
        poses[..., 2] += _FAR
        rows = list(numbers)
        data = [self._worlds[n].data for n in rows]
        position = np.array([d.xpos for d in data])[:, self._frames]
        quaternion = np.array([d.xquat for d in data])[:, self._frames][..., _LAST]
        poses[rows] = _moved(position, quaternion, self._local[rows])
        sensors = poses[:, self._places :].copy()
        others = np.ones(len(poses), np.bool_)
        others[rows] = False
        sensors[others, :, 2] -= 2 * _FAR
        found = self._fleet.step(poses[:, : self._places], sensors)
        # on Warp the next step writes its arrays anew
        matrix, delta, error, shields = (
            a if isinstance(a, np.ndarray) else np.array(a.numpy(), float)
            for a in (found.capacitance, found.delta, found.error, found.shield_coupling)
        )
        return [
            {
                site: Reading(
                    matrix[n, k], delta[n, k],
                    StepStats(float(error[n, k]), 0.0), self._names,
                    shields[n, k],
                )
                for k, site in enumerate(self._worlds[n].sites)
            }
            for n in numbers
        ]  # fmt: skip


class CapacitiveVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """Environments of one kind side by side; one call of a fleet reads all their sensors.

    Spaces, rewards, facts and random numbers are those of single environments. An environment
    whose episode has ended begins another at the next step, whatever its action, or in the same
    step: the last observations and facts are then ``final_obs`` and ``final_info`` among the
    facts, as of Gymnasium.

    Args:
        num_envs: How many there are.
        max_episode_steps: Episodes are cut after so many steps; None for no limit.
        device: What reads the sensors: ``"cpu"``, or a device of Warp, as of
            :class:`~capsense.fleet.Fleet`.
        autoreset_mode: ``"NextStep"`` or ``"SameStep"``, or as ``AutoresetMode``.
        options: Those of a single environment.

    Raises:
        ValueError: ``num_envs`` is not a whole number from 1, or there is no such mode.
        SceneError: An option is wrong.
        ReadoutError: There is no such chip or file, or the file is wrong.
        DesignError: The design is wrong.
    """

    world: ClassVar[type[CapacitiveEnv]]
    """What a single environment is."""

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        device: str = "cpu",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        self._mode = autoreset_of(autoreset_mode)
        if (as_whole(num_envs) or 0) < 1:
            raise ValueError(f"num_envs is {num_envs!r}; give a whole number from 1")
        num_envs = int(num_envs)
        first = self.world(**options)
        shared = {**options, "design": first.simulator}
        self.worlds = [first, *(self.world(**shared) for _ in range(num_envs - 1))]
        """The environments, which nobody else may step."""
        self.num_envs, self._limit = num_envs, max_episode_steps
        self.metadata = {**first.metadata, "autoreset_mode": self._mode}
        self.render_mode = first.render_mode
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, num_envs)
        self.action_space = batch_space(first.action_space, num_envs)
        self.skin = FleetSkin(self.worlds, device)
        self._observations = np.zeros(self.observation_space.shape or (), np.float32)
        self._steps = np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: Of the first environment, those of the others follow; or one for each.
            options: ``{"reset_mask": …}``: which environments begin, shape (num_envs,).

        Raises:
            SceneError: Another number of seeds, or a mask of another shape.
        """
        seeds, mask = seeds_of(seed, options, self.num_envs)
        infos: dict[str, Any] = {}
        self._begin(mask, seeds)
        for k, (observation, facts) in self._begun(mask).items():
            self._observations[k] = observation
            infos = self._add_info(infos, facts, k)
        return self._observations.copy(), infos

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One action for each environment.

        Raises:
            SceneError: Actions have another shape, or one is not finite.
        """
        if np.shape(actions) != self.action_space.shape:
            raise SceneError(
                f"actions have shape {np.shape(actions)}; give {self.action_space.shape}"
            )
        new, going = self._over.copy(), np.flatnonzero(~self._over).tolist()
        told = {k: self.worlds[k].advance(actions[k]) for k in going}
        self._begin(new, [None] * self.num_envs)
        self._steps[going] += 1
        rewards, over = np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)
        infos: dict[str, Any] = {}
        begun = self._begun(new, going)
        for k in range(self.num_envs):
            if k in begun:
                self._observations[k], facts = begun[k]
            else:
                rewards[k], over[k], facts = told[k]
                self._observations[k] = self.worlds[k].observe(self._now[k])
            infos = self._add_info(infos, facts, k)
        cut = ~new & (self._steps >= (self._limit or np.inf))
        self._over = over | cut
        if self._over.any() and self._mode == AutoresetMode.SAME_STEP:
            infos = self._begin_at_once(infos)
        return self._observations.copy(), rewards, over, cut, infos

    def _begin_at_once(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Begin new episodes where old ones have ended in this step; the facts of all."""
        new = self._over.copy()
        out = ended(new, self._observations, infos)
        self._begin(new, [None] * self.num_envs)
        begun = self._begun(new)
        for k in range(self.num_envs):
            if k in begun:
                self._observations[k], facts = begun[k]
            else:
                facts = {
                    name: value[k] for name, value in infos.items()
                    if not name.startswith("_") and infos[f"_{name}"][k]
                }  # fmt: skip
            out = self._add_info(out, facts, k)
        return out

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each environment; None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        return tuple(world.render() for world in self.worlds)

    def close(self, **kwargs: Any) -> None:
        """Close the environments."""
        for world in self.worlds:
            world.close()
        super().close(**kwargs)

    def _begin(self, mask: Bools, seeds: Sequence[int | None]) -> None:
        """Build the worlds of new episodes, and read what their chips are tared on."""
        chosen = np.flatnonzero(mask).tolist()
        self._tare: dict[int, Mapping[str, Reading]] = {}
        if not chosen:
            return
        for k in chosen:
            self.worlds[k].prepare(seeds[k])
        self.skin.take(chosen)
        self._tare = dict(zip(chosen, self.skin.read(chosen), strict=True))
        for k in chosen:
            self.worlds[k].present()
        self._steps[chosen], self._over[chosen] = 0, False

    def _begun(
        self, mask: Bools, going: Sequence[int] = ()
    ) -> dict[int, tuple[NDArray[np.float32], dict[str, Any]]]:
        """Read the worlds that go on and those that begin; what the latter begin with."""
        chosen = np.flatnonzero(mask).tolist()
        asked = sorted([*chosen, *going])
        self._now = dict(zip(asked, self.skin.read(asked), strict=True))
        return {k: self.worlds[k].switch_on(self._tare[k], self._now[k]) for k in chosen}


class LimbFollowVector(CapacitiveVectorEnv):
    """Many of :class:`~capsense.learning.envs.LimbFollow`."""

    world = LimbFollow


class DressingVector(CapacitiveVectorEnv):
    """Many of :class:`~capsense.learning.envs.Dressing`."""

    world = Dressing


class ApproachStopVector(CapacitiveVectorEnv):
    """Many of :class:`~capsense.learning.envs.ApproachStop`."""

    world = ApproachStop


def _solids(world: CapacitiveEnv) -> list[Solid]:
    """All that sensors may see in a world."""
    reader = ModelReader(world.model, Rules(**world.matter))
    found = [reader.solid(geom) for geom in range(world.model.ngeom)]
    return [solid for solid in found if solid is not None]


def _bodies(solids: Sequence[Solid]) -> list[Body]:
    """The bodies; parts of one person share the capacitance to ground evenly."""
    parts = Counter(solid.tie.owner for solid in solids)
    out = []
    for solid in solids:
        assert isinstance(solid.shape, Shape)  # the environments have no floors and terrains
        tie = solid.tie.grounding
        share = tie if isinstance(tie, str) else tie / parts[solid.tie.owner]
        out.append(Body(solid.shape, Pose(), solid.material, share, solid.label))
    return out


def _seven(pose: Pose) -> list[float]:
    return [*pose.position, *pose.quaternion]


def _moved(position: Array, quaternion: Array, local: Array) -> Array:
    """Poses in the world of what is fixed to moving frames, shape (..., 7)."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    v, s = local[..., 3:6], local[..., 6:]
    arm = local[..., :3]
    turned = arm + 2.0 * np.cross(u, np.cross(u, arm) + w * arm)
    vector = w * v + s * u + np.cross(u, v)
    scalar = w * s - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([position + turned, vector, scalar], axis=-1)
