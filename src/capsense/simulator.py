"""A sensor in a changing world: :class:`Simulator` turns scenes into readings."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, cast, get_args

import numpy as np
from numpy.typing import NDArray

from capsense._frozen import read_only
from capsense._thread_pool import ForkSafeRLock, ThreadPool, some_failed
from capsense._validate import as_number, checked_frequency, shorten
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import BatchError, CapSenseError, FieldError, ReadoutError
from capsense.field.background import BackgroundField, BuildSettings, Terminals
from capsense.field.boundary import terminals
from capsense.field.cache import default_settings, load_or_build
from capsense.reading import CapacitanceChange, KeptField, Reading, StepStats, Touch
from capsense.scene import Scene
from capsense.scene.contact import doubt_of, warn_of_contact
from capsense.scene.depth import DepthFrame

if TYPE_CHECKING:
    from capsense.masked import MeshSensor
    from capsense.mesh import TetMesh
    from capsense.readout import Readout

Array = NDArray[np.float64]
Method = Literal["surface", "fem_masked"]
PresetName = Literal["fast", "standard", "fine", "learning"]
"""Names of presets; ``"learning"`` is another name for ``"fast"``."""
DEFAULT_PRESET: PresetName = "standard"
"""The preset of whatever is given none."""
DEFAULT_DESIGN = "six_patch"
"""The design of whatever is given none."""
_OTHER_NAMES: dict[str, PresetName] = {"learning": "fast"}

_DOUBTFUL, _SEEN = 0.1, 1e-4
"""Estimated errors are warned of above this part of a change, and of the largest capacitance."""


ONCE = "Further warnings are suppressed; every reading has its own estimate, solver_error"


class Doubt(NamedTuple):
    """That the estimated error of a reading is large."""

    share: float
    """Estimated error over the largest change of an electrode."""
    text: str
    """What a warning says of it."""


class _Solver(Protocol):
    """What a method offers."""

    together: int
    """How many scenes of a batch a thread takes at a time, at most."""
    touch: float
    """What is nearer to an electrode than this [m] touches it."""

    def solve(
        self, scene: Scene, *, jacobian: bool = False, time: float | None = None
    ) -> CapacitanceChange: ...

    def solve_each(self, scenes: Sequence[Scene]) -> list[CapacitanceChange | CapSenseError]: ...

    def field(self) -> KeptField: ...

    def reset(self) -> None: ...


class Simulator:
    """Reads the capacitances of a sensor, scene after scene.

    Threads may share one: they take turns. :meth:`step_batch` uses several at a time.

    Args:
        design: A design, a packaged name, or the path of a design file; by default ``"six_patch"``.
        method: ``"surface"``: charges on the surfaces of the bodies. ``"fem_masked"``: the scheme
            of Schöffmann et al. 2022, where objects are staircases of tetrahedra. By default
            ``"fem_masked"`` on a mesh, else ``"surface"``.
        preset: How finely surfaces are resolved: ``"fast"``, ``"standard"`` or ``"fine"``; the
            accuracy page has the errors. ``"learning"`` is another name for ``"fast"``.
        excitation_frequency: Excitation frequency [Hz]; decides which materials conduct.
        settings: Numerical settings of the background field; default from ``design.build``.
        cache_dir: Where built fields are kept; default the user's cache directory.
        progress: Called with a stage's name and the fraction done while a field is built.
        background: The field of this design with these settings, if it is at hand; it is shared,
            not copied. :meth:`copy` passes its own.
        readout: What steps report through, as :meth:`use_readout` takes it.
        mesh: In place of a design, for ``"fem_masked"``: a tetrahedral mesh, or a
            :class:`~capsense.masked.MeshSensor`, which tells how its node groups are held. The
            baseline is then that of the mesh.

    Raises:
        DesignError: The design is wrong.
        MeshError: The mesh is not around the sensor frame's origin, or lacks a node group.
        ValueError: Both a design and a mesh are given, or an option is wrong.
        ReadoutError: There is no such chip or file, or the file is wrong.
        FieldError: The background field could not be built, or ``background`` is of another design.
    """

    def __init__(
        self,
        design: Design | str | Path | None = None,
        *,
        method: Method | None = None,
        preset: PresetName = DEFAULT_PRESET,
        excitation_frequency: float = 250e3,
        settings: BuildSettings | None = None,
        cache_dir: Path | None = None,
        progress: Callable[[str, float], None] | None = None,
        background: BackgroundField | None = None,
        readout: Readout | str | Path | None = None,
        mesh: TetMesh | MeshSensor | None = None,
    ) -> None:
        method = method or ("surface" if mesh is None else "fem_masked")
        if method not in get_args(Method):
            known = ", ".join(map(repr, get_args(Method)))
            raise ValueError(f"method is {shorten(method)}; choose one of {known}")
        self.method: Method = method
        self.preset: PresetName = checked_preset(preset)
        self.excitation_frequency = checked_frequency(excitation_frequency)
        if mesh is not None and design is not None:
            raise ValueError("give either a design or mesh=…, a TetMesh or a MeshSensor")
        self.mesh = None if mesh is None else self._on_mesh(mesh)
        """The mesh that was given in place of a design, or None."""
        given = self.mesh.design if self.mesh is not None else design or DEFAULT_DESIGN
        self.design = given if isinstance(given, Design) else load_design(given)
        if self.method == "fem_masked" and self.design.domain.open:
            raise ValueError(
                f"design {self.design.name!r} has an open domain, which method 'fem_masked' cannot "
                "mesh; use method 'surface', or leave out open = true"
            )
        self.settings = settings or default_settings(self.design)
        """Numerical settings of the background field."""
        self.steps = 0
        """Steps since the last reset, one that failed included."""
        names = tuple(terminals(self.design))
        if background is None and self.mesh is None:
            background = load_or_build(
                self.design, self.settings, cache_dir=cache_dir, progress=progress
            )
        elif background is not None and background.terminals != names:
            raise FieldError(
                f"the background field is of terminals {background.terminals}, but design "
                f"{self.design.name!r} has {names}; leave it out"
            )
        self._background = background
        self._solver, rest = self._make_solver()
        self._one = ForkSafeRLock()
        self._contact_told = False
        self._idle: deque[_Solver] = deque()  # for the threads of batches
        self._names = self.design.electrode_names
        self._terminals = Terminals(self.design, rest)
        n = self._terminals.electrodes
        self.baseline: Array = read_only(self._terminals.empty[:n, :n].copy())
        """Maxwell matrix of the electrodes in the empty domain [F], shape (M, M)."""
        self._doubtful = _SEEN * float(self.baseline.max())
        """Smaller estimated errors are not warned of [F]; infinite once one was."""
        self.doubt: Doubt | None = None
        """The large estimated error that the first reading with one had, if there was one."""
        self.in_skin = False
        """Whether a skin that reads this sensor warns of its ``doubt`` in its place."""
        self.readout: Readout | None = None
        """The chip that turns capacitances into counts, if any."""
        self.use_readout(readout)

    def _on_mesh(self, mesh: TetMesh | MeshSensor) -> MeshSensor:
        from capsense.masked import mesh_sensor

        if self.method != "fem_masked":
            raise ValueError(f'method {self.method!r} takes a design, not a mesh; use "fem_masked"')
        return mesh_sensor(mesh)

    def _make_solver(self) -> tuple[_Solver, Array]:
        """The solver, and the matrix of all terminals in the empty domain [F]."""
        if self.method == "fem_masked":
            from capsense.masked import MaskedScenes, lattice_sensor

            names = terminals(self.design)
            sensor = self.mesh or lattice_sensor(self.design, names, self.settings.mesh)
            scenes = MaskedScenes(
                sensor, self.excitation_frequency, electrodes=self.design.electrode_names
            )
            return scenes, self.background.capacitance if self.mesh is None else scenes.empty
        from capsense.solver.surface_solver import PRESETS, SurfaceSolver

        field = self.background
        return SurfaceSolver(
            field.green,
            self.design,
            excitation_frequency=self.excitation_frequency,
            preset=PRESETS[self.preset],
        ), field.capacitance

    @property
    def background(self) -> BackgroundField:
        """Field of the empty domain; never changed, so that it can be shared.

        Raises:
            FieldError: The sensor is given by a mesh, which needs none.
        """
        if self._background is None:
            raise FieldError("a simulator on a mesh has no background field; see its baseline")
        return self._background

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self._names

    @property
    def empty(self) -> Reading:
        """The reading of an empty scene, which no chip has seen."""
        empty = self._terminals.empty
        return self._reading(np.zeros_like(empty), empty, StepStats(0.0, 0.0))

    def use_readout(
        self,
        readout: Readout | str | Path | None,
        *,
        start: float | None = None,
        seed: int | None = None,
    ) -> None:
        """Read through a chip from now on.

        Args:
            readout: A readout of this sensor alone, the name of a chip with its usual settings,
                the path of a readout file (``.toml``), or None.
            start: Time at which it is switched on [s], by default 0.
            seed: Of its noise, by default its own.

        Raises:
            ReadoutError: There is no such chip or file, the file is wrong, or the seed is no whole
                number from 0 on.
        """
        from capsense.readout.config import make_readout

        self.readout = None
        if readout is not None:
            chip = make_readout(readout, self)
            chip.reset(start=0.0 if start is None else start, seed=seed)
            self.readout = chip

    def step(
        self,
        scene: Scene | DepthFrame,
        *,
        time: float | None = None,
        jacobian: bool = False,
        keep_field: bool = False,
    ) -> Reading:
        """Return the reading of a scene or of a depth camera's view, given in the sensor frame.

        With a :attr:`readout`, the reading holds the conversions that have finished since the last
        step, with their time stamps, as ``reading.counts``.

        Args:
            scene: What stands around the sensor.
            time: Time of the scene [s], not before that of the last step; a readout needs it, and
                the relaxation and hysteresis of a cover follow it: without it there are none.
            jacobian: Whether to work out ``reading.jacobian`` as well; it adds about 50 % to the
                step.
            keep_field: Whether the reading keeps what ``reading.potentials`` and
                ``reading.charges`` work with, of some megabytes.

        Raises:
            TypeError: ``scene`` is neither a scene nor a depth frame.
            SceneError: ``scene`` has no Jacobian, or its depth image is wrong.
            SolveError: The solver found no solution.
            ReadoutError: A readout is given no time, or time went back.
            ValueError: A Jacobian or the field is asked for of a method that has none.
        """
        check_view("step takes", scene)
        self._require(time)
        with self._one:
            return self.sampled(self._read(scene, time, jacobian, keep_field), time)

    def _require(self, time: float | None) -> None:
        if self.readout is not None and time is None:
            raise ReadoutError("a readout needs the time; write step(scene, time=…), in seconds")

    def sampled(self, reading: Reading, time: float | None) -> Reading:
        """A reading with what the :attr:`readout` makes of it at a time [s], if there is one.

        Raises:
            ReadoutError: It is given no time, or time went back.
        """
        self._require(time)
        with self._one:
            if self.readout is None or time is None:
                return reading
            return replace(reading, counts=self.readout.sample(time, reading))

    def solved(
        self,
        scene: Scene | DepthFrame,
        *,
        time: float | None = None,
        jacobian: bool = False,
        keep_field: bool = False,
    ) -> Reading:
        """As :meth:`step`, without the readout, which is left as it is."""
        check_view("step takes", scene)
        with self._one:
            return self._read(scene, time, jacobian, keep_field)

    def _read(
        self, scene: Scene | DepthFrame, time: float | None, jacobian: bool, keep_field: bool
    ) -> Reading:
        """Solve a scene; see :meth:`step`."""
        start = perf_counter()
        if jacobian and self.method == "fem_masked":
            raise ValueError('method "fem_masked" has no Jacobian; use "surface"')
        if keep_field and self.method == "fem_masked":
            raise ValueError('method "fem_masked" keeps no field; use "surface"')
        if isinstance(scene, DepthFrame):
            scene = scene.scene()
        self.steps += 1
        found = self._solver.solve(scene, jacobian=jacobian, time=time)
        reading = self._of(found, scene, perf_counter() - start)
        return reading.with_field(self._solver.field()) if keep_field else reading

    def _of(self, found: CapacitanceChange, scene: Scene, seconds: float) -> Reading:
        """The reading that a solver's result makes, which took some time [s]."""
        terminals = self._terminals
        change: NDArray[Any] = terminals.screened(found.matrix)
        if math.isinf(found.error):
            change = terminals.grounded(change)
            if not self._contact_told:
                self._contact_told = True
                surfaces = {e.name: e.surface.triangles for e in self.design.electrodes}
                warn_of_contact(scene, surfaces, self._solver.touch)
        error = max(found.error, float((found.matrix - change).max()))
        if found.loss is not None:
            change = change - 1j * found.loss
        slope = None if found.jacobian is None else terminals.slope(change, found.jacobian)
        whole, change = change, terminals.change(change)
        total = terminals.empty + change
        error = float(terminals.error(np.array(error), whole, change))
        error = min(error, float(np.abs(total).max()))
        stats = StepStats(error, seconds, found.unknowns, found.iterations)
        if self._doubtful < error and not math.isinf(found.error):
            self._tell_of_doubt(scene, np.abs(np.diag(change.real)), error, found.reason)
        reading = self._reading(change.real, total.real, stats, slope, found.touch)
        if not reading.delta.any():
            scene.warn_of_units(max(self.design.domain.size))
        if found.loss is None:
            return reading
        n = terminals.electrodes
        return replace(
            reading, conductance=-2 * np.pi * self.excitation_frequency * change.imag[:n, :n]
        )

    def _tell_of_doubt(
        self, scene: Scene, own: Array, error: float, reason: Callable[[], str]
    ) -> None:
        """Warn once where an estimated error is a large part of the change of an electrode [F]."""
        doubt = self._doubt(scene, own[: self._terminals.electrodes], error, reason)
        if doubt is None:
            return
        self._doubtful, self.doubt = math.inf, doubt
        if not self.in_skin:
            warnings.warn(f"{doubt.text}. {ONCE}", stacklevel=4)

    def _doubt(
        self, scene: Scene, own: Array, error: float, reason: Callable[[], str]
    ) -> Doubt | None:
        """What is said of an estimated error, if it is a large part of electrodes' changes [F]."""
        most = int(own.argmax())
        if error <= _DOUBTFUL * own[most]:
            return None
        electrode = self.design.electrodes[most]
        share = error / max(own[most], 1e-300)
        surface = electrode.name, electrode.surface.triangles
        return Doubt(share, doubt_of(scene, surface, share, reason()))

    def doubt_about(self, scene: Scene, reading: Reading) -> Doubt | None:
        """What :meth:`step` would warn of, had it given a reading of a scene as its first one."""
        error = reading.stats.solver_error
        if error <= _SEEN * float(self.baseline.max()):
            return None
        return self._doubt(scene, np.abs(np.diag(reading.delta)), error, str)

    @property
    def touch(self) -> float:
        """What is nearer to an electrode than this [m] touches it."""
        return self._solver.touch

    def _reading(
        self,
        change: Array,
        total: Array,
        stats: StepStats,
        slope: Array | None = None,
        touch: Touch | None = None,
    ) -> Reading:
        """A reading by the matrix of electrodes and shields and its change [F]."""
        n = self._terminals.electrodes
        delta = change[:n, :n]
        return Reading(
            self.baseline + delta,
            delta.copy(),
            stats,
            self._names,
            total[:n, n:].sum(axis=1),
            jacobian=slope,
            touch=touch,
        )

    def step_batch(
        self,
        scenes: Sequence[Scene | DepthFrame],
        *,
        times: Sequence[float] | None = None,
        threads: int | None = None,
    ) -> list[Reading]:
        """Return the readings of many scenes, each solved on whichever thread is free.

        Capacitances are those of :meth:`reset` and :meth:`step`, to the last bit. They do not
        depend on the number of threads, nor on what stands beside them in the batch: a cover has
        no relaxation and no hysteresis. This sensor's own last step and count stay as they are.

        A :attr:`readout` goes on from where it is. It is told the scenes in their order, once all
        of them are solved; if some fail, it is told none.

        Args:
            scenes: Scenes or depth frames, in the sensor frame.
            times: Their times [s], none before the one in front of it; a readout needs them.
            threads: How many threads solve; by default as many as the process may use processors.

        Raises:
            TypeError: Something in ``scenes`` is neither a scene nor a depth frame.
            ValueError: ``times`` are not as many as the scenes, or ``threads`` is not a positive
                whole number.
            ReadoutError: A readout is given no times, or time goes back.
            BatchError: Some scenes failed; it holds the readings of the others, without counts.
        """
        scenes = list(scenes)
        told = None if times is None else [as_number(time) for time in times]
        if told is not None and len(told) != len(scenes):
            raise ValueError(f"{len(told)} times for {len(scenes)} scenes; give one for each")
        chip = self.readout
        if chip is None:
            return self.solved_batch(scenes, threads=threads)
        if told is None:
            raise ReadoutError(
                "a readout needs the times of the scenes; write step_batch(scenes, times=[…]), in "
                "seconds, or solved_batch(scenes) for capacitances alone"
            )
        with self._one:
            chip.require_times(told)
            readings = self.solved_batch(scenes, threads=threads)
            return [
                replace(reading, counts=chip.sample(time, reading))
                for time, reading in zip(told, readings, strict=True)
            ]

    def solved_batch(
        self, scenes: Sequence[Scene | DepthFrame], *, threads: int | None = None
    ) -> list[Reading]:
        """The same as :meth:`step_batch`, without the readout, which is left as it is."""
        scenes = list(scenes)
        for number, scene in enumerate(scenes):
            check_view(f"scenes[{number}]: a batch holds", scene)

        readings, failures = ThreadPool(threads).run_together(
            [range(len(scenes))], self.together,
            lambda some: read_together([self] * len(some), [scenes[k] for k in some]),
        )  # fmt: skip
        if failures:
            raise BatchError(some_failed("scenes", failures, len(scenes)), readings, failures)
        return list(readings.values())

    @property
    def together(self) -> int:
        """How many scenes a thread takes at a time, at most."""
        return self._solver.together

    @property
    def kind(self) -> Hashable:
        """Simulators of one kind can be read in one call, see :func:`read_together`.

        A cover remembers its contacts, and the method ``"fem_masked"`` its last step: such
        simulators are each of a kind of their own.
        """
        if self.method != "surface" or self.design.cover is not None:
            return id(self)
        return id(self._background), self.preset, self.excitation_frequency

    def copy(self) -> Simulator:
        """Another sensor of the same design and settings, at rest; the two share the field.

        It has no readout: a chip belongs to one sensor.
        """
        return Simulator(
            None if self.mesh else self.design, method=self.method, preset=self.preset,
            excitation_frequency=self.excitation_frequency, settings=self.settings,
            background=self._background, mesh=self.mesh,
        )  # fmt: skip

    def reset(self, *, start: float | None = None, seed: int | None = None) -> None:
        """Forget the step before, see :meth:`forget`, and restart the chip.

        Args:
            start: Time at which it is switched on [s], by default 0.
            seed: Of its noise from now on; by default its random numbers repeat.

        Raises:
            ReadoutError: The seed is no whole number from 0 on.
        """
        with self._one:
            self.forget()
            if self.readout is not None:
                self.readout.reset(start=0.0 if start is None else start, seed=seed)

    def forget(self) -> None:
        """Forget the step before, from which ``"fem_masked"`` starts, and what the cover remembers
        of its contacts. The chip goes on."""
        with self._one:
            self._solver.reset()
            self.steps = 0

    def describe(self) -> dict[str, float | int | str]:
        """Return the figures of the design's field."""
        told: dict[str, float | int | str] = {
            "design": self.design.name, "electrodes": len(self.design.electrodes),
            "method": self.method,
        }  # fmt: skip
        if self.mesh is not None:
            return told | {"tetrahedra": self.mesh.mesh.n_tets, "nodes": self.mesh.mesh.n_points}
        green = self.background.green
        return told | {
            "boundary panels": self.background.n_panels,
            "point charges": len(green.near_sources), "modes": green.n_modes,
        }  # fmt: skip


def read_together(
    simulators: Sequence[Simulator], scenes: Sequence[Scene | DepthFrame]
) -> list[Reading | CapSenseError]:
    """Readings of simulators of one kind without their readouts, or what was wrong with them.

    They are those of :meth:`Simulator.solved` from rest, to the last bit; what they share is done
    once.

    Args:
        simulators: Simulators of one :attr:`Simulator.kind`; one may come several times.
        scenes: What each sees, in its frame.
    """
    start = perf_counter()
    first, out = simulators[0], dict[int, Reading | CapSenseError]()
    plain: dict[int, Scene] = {}
    for k, scene in enumerate(scenes):
        try:
            plain[k] = scene.scene() if isinstance(scene, DepthFrame) else scene
        except CapSenseError as error:
            out[k] = error
    try:
        solver = first._idle.popleft()
    except IndexError:
        solver = first.copy()._solver
    try:
        found = solver.solve_each(list(plain.values()))
    finally:
        first._idle.append(solver)
    seconds = (perf_counter() - start) / len(scenes)
    for (k, scene), f in zip(plain.items(), found, strict=True):
        out[k] = f if isinstance(f, CapSenseError) else simulators[k]._of(f, scene, seconds)
    return [out[k] for k in range(len(scenes))]


def checked_preset(preset: object) -> PresetName:
    """The name of a preset, by the one name that it goes by.

    Raises:
        ValueError: There is none of that name.
    """
    known = [name for name in get_args(PresetName) if name not in _OTHER_NAMES]
    if not isinstance(preset, str) or preset not in (*known, *_OTHER_NAMES):
        raise ValueError(
            f"preset is {shorten(preset)}; choose one of {', '.join(map(repr, known))}"
        )
    return cast("PresetName", _OTHER_NAMES.get(preset, preset))


def check_view(where: str, scene: object) -> None:
    """Refuse what is neither a scene nor a depth frame.

    Raises:
        TypeError: It is neither.
    """
    if not isinstance(scene, (Scene, DepthFrame)):
        raise TypeError(
            f"{where} a Scene or a DepthFrame, not {type(scene).__name__}; write Scene([...])"
        )
