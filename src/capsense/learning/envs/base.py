"""What the environments share: what differs from episode to episode, a model, a limb, one step."""

from __future__ import annotations

import dataclasses
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.random import Generator
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.adapters import mujoco as adapter
from capsense.adapters.rules import AttachOptions
from capsense.errors import SceneError
from capsense.humans import Build, Limb, arm
from capsense.learning.envs.picture import Camera, draw_world
from capsense.learning.envs.scale import LIMIT, compressed
from capsense.learning.envs.signals import Signals
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.readout.calibration import LinearSensor
from capsense.readout.config import make_readout
from capsense.readout.noise import RandomWalk
from capsense.readout.presets import chip_of
from capsense.scene import Material, Pose
from capsense.simulator import PresetName, Simulator
from capsense.skin import AnyDesign

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
Range = tuple[float, float]

CONTROL = 0.04
"""Time from one action to the next [s]."""
_AWAY = Pose((0.0, 0.0, 50.0))
"""Where the limb is while the chips are tared."""
SQUEEZE = 0.02
"""What one newton of contact force costs at every step."""
_LOG = ("grounding", "permittivity")
"""Uniform in the logarithm."""
_GIRTHS = 8
"""Girths take so many values, as bodies of proportions that were met before cost less time."""


@dataclass(frozen=True)
class Drawn:
    """What holds for one episode; see :class:`Randomisation`."""

    female: float
    percentile: float
    girth: float
    shift: float
    turn: float
    permittivity: float
    grounding: float
    gain: float
    noise: float
    drift: float
    latency: float

    @property
    def build(self) -> Build:
        """The size of the person."""
        sex = "female" if self.female > 0.5 else "male"
        return Build(sex, percentile=self.percentile, girth=self.girth)  # type: ignore[arg-type]

    def readout(self, chip: Readout | str | Path, sensor: Simulator, rng: Generator) -> Readout:
        """The readout of one sensor, with a gain of its own.

        A chip by its name has its highest rate, and the noise that was drawn. A file or a readout
        keeps its rate and its noise; gain, drift and latency come on top.

        Raises:
            ReadoutError: There is no such chip or file, or the file is wrong.
        """
        gain = 1.0 + self.gain * rng.uniform(-1.0, 1.0)
        stage = LinearSensor(np.array(gain), np.array(0.0), np.array(0.0), 0.0)
        if isinstance(chip, str) and not chip.endswith(".toml"):
            rate = max(r.per_second for r in chip_of(chip).rates)
            return Readout.preset(
                chip, sensor.electrode_names, rate=rate, latency=self.latency, white=self.noise,
                walk=self.drift, stages=(stage,),
            )  # fmt: skip
        own = make_readout(chip, sensor)
        walk = (RandomWalk(self.drift),) if self.drift else ()
        plan = dataclasses.replace(own.schedule, latency=own.schedule.latency + self.latency)
        return Readout(
            own.bank, plan, own.law, dac=own.dac, wiring=own.wiring, detector=own.detector,
            stages=(stage, *own.stages, *walk), seed=own.seed,
        )  # fmt: skip


@dataclass(frozen=True)
class Randomisation:
    """Ranges ``(low, high)`` that every episode draws from.

    ``Randomisation().held()`` draws the middle of them always.

    Raises:
        SceneError: A range falls, or is not of two finite numbers.
    """

    female: Range = (0.0, 1.0)
    """Above one half the person is female, below male."""
    percentile: Range = (5.0, 95.0)
    """Of stature within the sex."""
    girth: Range = (0.85, 1.2)
    """Factor on circumferences."""
    shift: Range = (0.0, 0.03)
    """How far the limb or the sensor is from its usual place, in any direction [m]."""
    turn: Range = (0.0, 0.25)
    """How far it is turned, about any axis [rad]."""
    permittivity: Range = (1.1, 4.0)
    """Relative permittivity of what lies beneath the limb: foam to dense rubber or damp cloth."""
    grounding: Range = (30e-12, 300e-12)
    """What ties the person to ground [F]."""
    gain: Range = (0.0, 0.05)
    """Largest error of the readout's gain."""
    noise: Range = (0.2e-15, 1e-15)
    """Rms of the noise of one conversion [F]."""
    drift: Range = (0.0, 0.2e-15)
    """Random walk of each channel [F/√s]."""
    latency: Range = (0.0, 0.03)
    """From the end of a conversion until its result can be read [s]."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low, high = getattr(self, field.name)
            if not (np.isfinite([low, high]).all() and low <= high):
                raise SceneError(
                    f"randomisation: {field.name} is {(low, high)}; give two finite numbers that "
                    "do not fall"
                )

    @classmethod
    def of(cls, given: Randomisation | Mapping[str, Sequence[float]] | None) -> Randomisation:
        """One that is given, or made of some ranges by name; else the usual one.

        Raises:
            SceneError: There is no range of a name, or one is wrong.
        """
        if isinstance(given, Randomisation):
            return given
        known = [field.name for field in dataclasses.fields(cls)]
        for name, pair in (given or {}).items():
            if name not in known:
                raise SceneError(f"randomisation: no range {name!r}; {suggest(name, known)}")
            if not isinstance(pair, Sequence) or len(pair) != 2:
                raise SceneError(f"randomisation: {name} is {pair!r}; give two numbers")
        return cls(**{name: (pair[0], pair[1]) for name, pair in (given or {}).items()})

    def held(self) -> Randomisation:
        """The middle of every range, and nothing random."""
        middle = {f.name: self._at(f.name, 0.5) for f in dataclasses.fields(self)}
        return Randomisation(**{name: (value, value) for name, value in middle.items()})

    def draw(self, rng: Generator) -> Drawn:
        """What holds for an episode."""
        shares = {f.name: rng.random() for f in dataclasses.fields(self)}
        shares["girth"] = round(shares["girth"] * (_GIRTHS - 1)) / (_GIRTHS - 1)
        return Drawn(**{name: self._at(name, share) for name, share in shares.items()})

    def _at(self, name: str, share: float) -> float:
        low, high = getattr(self, name)
        return float(low * (high / low) ** share if name in _LOG else low + share * (high - low))


@contextmanager
def _without_estimates() -> Iterator[None]:
    """No warnings of large estimated errors.

    The estimates count the robot's own links beside the sensors too, which are tared away; and
    ranges of randomisation go from within touch to out of sight. ``skin.read()`` tells them all
    the same, as ``stats.solver_error``.
    """
    with warnings.catch_warnings():
        # what attach finds of the scene, if it is nothing else
        found = r"scene: .*the estimated error of electrode .*\Z"
        warnings.filterwarnings("ignore", found, UserWarning)
        warnings.filterwarnings("ignore", r".*large estimated errors?", UserWarning)
        yield


class CapacitiveEnv(gymnasium.Env[Observation, NDArray[np.float32]], ABC):
    """Capacitive sensors on a moving body, and a person's arm.

    Actions are velocities of the model's actuators, each from -1 to 1 of its :attr:`speeds`.
    Observations are those of :class:`~capsense.learning.envs.signals.Signals`, then positions [m
    or rad] and velocities [m/s or rad/s] of the joints that the actuators move, then what a task
    adds. The same seed gives the same episode, to the last bit.

    Args:
        randomisation: What episodes draw from, or some of its ranges by name.
        chip: Name of the chip behind every sensor, a readout file, or a readout.
        preset: How finely the solver resolves surfaces.
        design: Sensor design, instead of the task's own; or a simulator, whose field is shared.
        normalise: Whether changes of capacitance are within ±1, see
            :func:`~capsense.learning.envs.scale.compressed`.
        render_mode: None, or ``"rgb_array"``: pictures by MuJoCo's rays, without OpenGL.

    Raises:
        SceneError: A range of the randomisation is wrong.
        ReadoutError: There is no such chip or file, or the file is wrong.
        DesignError: The design is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012, as in Gymnasium
    model_file: ClassVar[str]
    """The MJCF file beside this module; its body ``limb`` is moved by the task."""
    sites: ClassVar[tuple[str, ...]]
    """Sites of the sensors."""
    own_design: ClassVar[str]
    """The sensors' design."""
    speeds: ClassVar[tuple[float, ...]]
    """Of the actuators, in their order [m/s or rad/s]."""
    parts: ClassVar[tuple[str, ...]]
    """Segments of the arm that are there."""
    camera: ClassVar[Camera] = Camera((0.4, -0.6, 0.25), (0.06, 0.0, -0.02))
    """Where pictures are taken from."""
    extra: ClassVar[tuple[str, ...]] = ()
    """Names of the numbers that :meth:`also` adds to observations."""

    def __init__(
        self,
        randomisation: Randomisation | Mapping[str, Sequence[float]] | None = None,
        chip: Readout | str | Path = "fdc1004",
        preset: PresetName = "fast",
        design: AnyDesign | None = None,
        normalise: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self._normalise, self.render_mode = normalise, render_mode
        self.randomisation = Randomisation.of(randomisation)
        self._chip = chip
        own = design or self.own_design
        self.simulator = own if isinstance(own, Simulator) else Simulator(own, preset=preset)
        self.drawn = self.randomisation.held().draw(np.random.default_rng(0))
        """What holds for this episode."""
        self._build(np.random.default_rng(0))
        self.action_space = Box(-1.0, 1.0, (len(self.speeds),), np.float32)
        rest = np.full(2 * len(self.speeds) + len(self.extra), LIMIT, np.float32)
        most = np.concatenate([self.signals.limits, rest])
        self.observation_space = Box(-most, most, dtype=np.float32)

    # -- what a task says ------------------------------------------------------------------------

    @abstractmethod
    def begin(self) -> dict[str, float]:
        """Draw the task's own random numbers; return joint angles of the limb [rad]."""

    @abstractmethod
    def limb_pose(self, time: float) -> Pose:
        """Where the limb's frame is at a time [s]."""

    @abstractmethod
    def judge(self, action: Array, force: float) -> tuple[float, bool, dict[str, Any]]:
        """Reward of the step that was made, whether the episode ends by it, and facts about it."""

    def also(self) -> Array:
        """Further numbers for observations, shape (extra,)."""
        return np.empty(0)

    # -- Gymnasium -------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode with a new person, place and chip; ``options`` are not used."""
        self.prepare(seed)
        with _without_estimates():
            self.attach()
            tare = self.skin.read()
            self.present()
            return self.switch_on(tare, self.skin.read())

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move at the velocities that an action tells, for 0.04 s.

        Raises:
            SceneError: The action has another shape, or is not finite.
        """
        reward, over, facts = self.advance(action)
        with _without_estimates():
            return self.observe(self.skin.read()), reward, over, False, facts

    def render(self) -> Any:
        """A picture of the scene, shape (240, 320, 3); electrodes are drawn the redder, the more
        they feel. None without ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            return None
        surfaces = [e.surface.triangles for e in self.simulator.design.electrodes]
        electrodes = [
            (self.data.site(site), triangles, float(strength))
            for site in self.sites
            for triangles, strength in zip(surfaces, self._loud(site), strict=True)
        ]
        return draw_world(self.model, self.data, self.camera, electrodes)

    def _loud(self, site: str) -> Array:
        """How much each electrode of a sensor feels, from 0 to 1; by other channels, their mean."""
        n, felt = len(self.simulator.electrode_names), self.signals.felt.get(site)
        if felt is None:
            return np.zeros(n)
        loud = np.abs(compressed(felt))
        return loud if len(loud) == n else np.full(n, loud.mean())

    # -- the same in parts, between which somebody reads the sensors -----------------------------

    def prepare(self, seed: int | None) -> None:
        """Draw an episode and build its world; the person is away, as chips are tared then."""
        super().reset(seed=seed)
        self.drawn = self.randomisation.draw(self.np_random)
        self._build(self.np_random)
        self._move_limb(_AWAY)
        mujoco.mj_forward(self.model, self.data)

    def attach(self) -> None:
        """Attach the sensors to the world."""
        self.skin = adapter.attach_skin(
            self.model, self.data, self.sites, self.simulator, threads=1, **self.matter
        )
        """The sensors, as they are without chips."""

    def present(self) -> None:
        """The person comes."""
        self._move_limb(self.limb_pose(0.0))
        mujoco.mj_forward(self.model, self.data)

    def switch_on(
        self, tare: Mapping[str, Reading], now: Mapping[str, Reading]
    ) -> tuple[Observation, dict[str, Any]]:
        """The first observation and facts, from readings without the person and with it."""
        self.signals.reset(0.0, int(self.np_random.integers(2**31)), tare, now)
        return self.observe(now), self.judge(np.zeros(len(self.speeds)), 0.0)[2]

    def advance(self, action: NDArray[np.float32]) -> tuple[float, bool, dict[str, Any]]:
        """Move as :meth:`step` says; reward, whether the episode ends, and facts."""
        asked = np.asarray(action, dtype=float)
        if asked.shape != (len(self.speeds),) or not np.isfinite(asked).all():
            raise SceneError(f"action is {action!r}; give {len(self.speeds)} finite numbers")
        asked = np.clip(asked, -1.0, 1.0)
        self.data.ctrl[:] = asked * self.speeds
        steps, force = round(CONTROL / self.model.opt.timestep), 0.0
        for _ in range(steps):
            self._move_limb(self.limb_pose(self.data.time))
            mujoco.mj_step(self.model, self.data)
            force = max(force, self._force())
        mujoco.mj_forward(self.model, self.data)
        reward, over, facts = self.judge(asked, force)
        return reward - SQUEEZE * force, over, {**facts, "force": force}

    def observe(self, now: Mapping[str, Reading]) -> Observation:
        """The observation, from what the sensors read now."""
        m, joints = self.model, self.model.actuator_trnid[:, 0]
        places, rates = self.data.qpos[m.jnt_qposadr[joints]], self.data.qvel[m.jnt_dofadr[joints]]
        own = np.concatenate([places, rates, self.also()])
        rest = np.clip(own, -LIMIT, LIMIT).astype(np.float32)
        return np.concatenate([self.signals.read(self.data.time, now), rest])

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the actions move, joints of the model."""
        return tuple(self.model.joint(k).name for k in self.model.actuator_trnid[:, 0])

    @property
    def observation_names(self) -> tuple[str, ...]:
        """What the numbers of an observation are called."""
        rates = tuple(f"{name}.velocity" for name in self.action_names)
        return (*self.signals.names, *self.action_names, *rates, *self.extra)

    @property
    def matter(self) -> AttachOptions:
        """What the sensors see is made of, as ``attach_skin`` takes it."""
        cushion = Material("cushion", self.drawn.permittivity)
        return {"materials": {"limb*": "human", "cushion": cushion},
                "grounding": {"limb*": self.drawn.grounding}}  # fmt: skip

    # -- the world -------------------------------------------------------------------------------

    def _build(self, rng: Generator) -> None:
        """Make the model anew, with a limb of the size that was drawn, and the chips."""
        self._rng = rng
        self.limb = self.make_limb()
        spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name(self.model_file)))
        angles = self.begin()
        self._add_limb(spec, angles)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._move_limb(self.limb_pose(0.0))
        self.start()
        mujoco.mj_forward(self.model, self.data)
        self.signals = Signals(
            {site: self.drawn.readout(self._chip, self.simulator, rng) for site in self.sites},
            self._normalise,
        )

    def make_limb(self) -> Limb:
        """The limb of the person that was drawn."""
        return arm(self.drawn.build)

    def start(self) -> None:
        """Set the state in which an episode begins; the limb is there already."""

    def _add_limb(self, spec: mujoco.MjSpec, angles: dict[str, float]) -> None:
        where, body = self.limb.forward(angles), spec.body("limb")
        for segment in self.limb.segments:
            if segment.name not in self.parts:
                continue
            for name, part in self.limb.named_parts(segment):
                pose = where[segment.name] @ part.pose
                x, y, z, w = pose.quaternion
                body.add_geom(
                    name=f"limb_{name}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, pos=pose.position,
                    quat=(w, x, y, z), size=(part.radius, 0.5 * part.shape.length, 0.0),
                    contype=1, conaffinity=1,
                )  # fmt: skip

    def _move_limb(self, pose: Pose) -> None:
        self.data.mocap_pos[0] = pose.position
        self.data.mocap_quat[0] = (pose.quaternion[3], *pose.quaternion[:3])

    def _force(self) -> float:
        """Sum of the normal forces of all contacts [N]."""
        total, one = 0.0, np.zeros(6)
        for k in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, k, one)
            total += abs(float(one[0]))
        return total

    # -- help for tasks --------------------------------------------------------------------------

    def clearance(self) -> float:
        """Distance between the robot and the person [m], at most 0.5."""
        m = self.model
        person = m.geom_bodyid == m.body("limb").id
        robot = np.flatnonzero(~person & (m.geom_conaffinity != 0))
        pairs = product(robot.tolist(), np.flatnonzero(person).tolist())
        return min(mujoco.mj_geomDistance(m, self.data, a, b, 0.5, None) for a, b in pairs)

    def site_frame(self, site: str) -> tuple[Array, Array]:
        """Position [m] and rotation matrix of a site in the world."""
        here = self.data.site(site)
        return here.xpos.copy(), here.xmat.reshape(3, 3).copy()

    def astray(self, turned: bool = False) -> Array:
        """A random shift [m], or turn [rad], of the size that was drawn, shape (3,)."""
        way = self._rng.standard_normal(3)
        return (self.drawn.turn if turned else self.drawn.shift) * way / np.linalg.norm(way)

    def between(self, low: float, high: float) -> float:
        """A random number of the task's own."""
        return float(self._rng.uniform(low, high))
