"""A sensor in a changing world: :class:`Simulator` turns scenes into readings."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import read_only
from capsense._thread_pool import ForkSafeRLock, ThreadPool, some_failed
from capsense._validate import checked_frequency, shorten
from capsense.cover import Touch
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import BatchError, CapSenseError, FieldError, ReadoutError, SceneError
from capsense.field.background import (
    BackgroundField,
    BuildSettings,
    CapacitanceChange,
    Charges,
    Terminals,
)
from capsense.field.boundary import terminals
from capsense.field.cache import default_settings, load_or_build
from capsense.reading import Reading, StepStats
from capsense.scene import Scene
from capsense.scene.contact import warn_of_contact, warn_of_doubt
from capsense.scene.depth import DepthFrame
from capsense.scene.shapes import as_points

if TYPE_CHECKING:
    from capsense.masked import MeshSensor
    from capsense.mesh import TetMesh
    from capsense.readout import Readout

Array = NDArray[np.float64]
Method = Literal["surface", "fem_masked"]
PresetName = Literal["standard", "learning", "fine"]

_TURNS = 6
"""Parts of a batch, for each thread, at least: no thread then waits long for another."""


_DOUBTFUL, _SEEN = 0.1, 1e-4
"""Estimated errors are warned of above this part of a change, and of the largest capacitance."""


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

    def potentials(self, points: Array) -> Array: ...

    def charges(self) -> Charges | None: ...

    def reset(self) -> None: ...


class Simulator:
    """Reads the capacitances of a sensor, scene after scene.

    Threads may share one: they take turns. :meth:`step_batch` uses several at a time.

    Args:
        design: A design, a packaged name, or the path of a design file.
        method: ``"surface"``: charges on the surfaces of the bodies. ``"fem_masked"``: the scheme
            of Schöffmann et al. 2022, where objects are staircases of tetrahedra. By default
            ``"fem_masked"`` on a mesh, else ``"surface"``.
        preset: How finely surfaces are resolved: ``"standard"``, ``"learning"`` (faster, some
            3 % rms) or ``"fine"``.
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
        ValueError: Neither or both of design and mesh are given, or an option is wrong.
        ReadoutError: There is no such chip or file, or the file is wrong.
        FieldError: The background field could not be built, or ``background`` is of another design.
    """

    def __init__(
        self,
        design: Design | str | Path | None = None,
        *,
        method: Method | None = None,
        preset: PresetName = "standard",
        excitation_frequency: float = 250e3,
        settings: BuildSettings | None = None,
        cache_dir: Path | None = None,
        progress: Callable[[str, float], None] | None = None,
        background: BackgroundField | None = None,
        readout: Readout | str | Path | None = None,
        mesh: TetMesh | MeshSensor | None = None,
    ) -> None:
        method = method or ("surface" if mesh is None else "fem_masked")
        for what, chosen, known in (
            ("method", method, get_args(Method)), ("preset", preset, get_args(PresetName)),
        ):  # fmt: skip
            if chosen not in known:
                raise ValueError(
                    f"{what} is {shorten(chosen)}; choose one of {', '.join(map(repr, known))}"
                )
        self.method: Method = method
        self.preset: PresetName = preset
        self.excitation_frequency = checked_frequency(excitation_frequency)
        if (mesh is None) == (design is None):
            raise ValueError("give either a design or mesh=…, a TetMesh or a MeshSensor")
        self.mesh = None if mesh is None else self._on_mesh(mesh)
        """The mesh that was given in place of a design, or None."""
        given = self.mesh.design if self.mesh is not None else cast("Design | str | Path", design)
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

    def use_readout(self, readout: Readout | str | Path | None, *, start: float = 0.0) -> None:
        """Read through a chip from now on.

        Args:
            readout: A readout of this sensor alone, the name of a chip with its usual settings,
                the path of a readout file (``.toml``), or None.
            start: Time at which it is switched on [s].

        Raises:
            ReadoutError: There is no such chip or file, or the file is wrong.
        """
        self.readout = None
        if readout is not None:
            from capsense.readout.config import make_readout

            self.readout = make_readout(readout, self)
            self.readout.reset(start=start)

    def step(
        self, scene: Scene | DepthFrame, *, time: float | None = None, jacobian: bool = False
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

        Raises:
            SceneError: ``scene`` is neither a scene nor a depth frame, or has no Jacobian.
            SolveError: The solver found no solution.
            ReadoutError: A readout is given no time, or time went back.
            ValueError: A Jacobian is asked for of a method that has none.
        """
        start = perf_counter()
        _check_view("step takes", scene)
        if jacobian and self.method == "fem_masked":
            raise ValueError('method "fem_masked" has no Jacobian; use "surface"')
        if self.readout is not None and time is None:
            raise ReadoutError("a readout needs the time; write step(scene, time=…), in seconds")
        if isinstance(scene, DepthFrame):
            scene = scene.scene()
        with self._one:
            self.steps += 1
            found = self._solver.solve(scene, jacobian=jacobian, time=time)
            reading = self._of(found, scene, perf_counter() - start)
            if self.readout is None or time is None:
                return reading
            return replace(reading, counts=self.readout.sample(time, reading))

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
        change = terminals.change(change)
        total = terminals.empty + change
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
        own = own[: self._terminals.electrodes]
        most = int(own.argmax())
        if error <= _DOUBTFUL * own[most]:
            return
        self._doubtful = math.inf
        electrode = self.design.electrodes[most]
        share = error / max(own[most], 1e-300)
        warn_of_doubt(scene, (electrode.name, electrode.surface.triangles), share, reason())

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
        self, scenes: Sequence[Scene | DepthFrame], *, threads: int | None = None
    ) -> list[Reading]:
        """Return the readings of many scenes, each solved on whichever thread is free.

        Readings are those of :meth:`reset` and :meth:`step`, to the last bit, without a readout.
        They do not depend on the number of threads, nor on what stands beside them in the batch.
        This sensor's own last step and count stay as they are.

        Args:
            scenes: Scenes or depth frames, in the sensor frame.
            threads: How many threads solve; by default as many as the process may use processors.

        Raises:
            SceneError: Something in ``scenes`` is neither a scene nor a depth frame, or
                ``threads`` is not a positive whole number.
            BatchError: Some scenes failed; it holds the readings of the others.
        """
        scenes = list(scenes)
        for number, scene in enumerate(scenes):
            _check_view(f"scenes[{number}]: a batch holds", scene)

        pool = ThreadPool(threads)
        size = min(self._solver.together, -(-len(scenes) // (_TURNS * pool.threads)))
        starts = range(0, len(scenes), max(size, 1))
        parts, lost = pool.run({k: partial(self._each, scenes[k : k + size]) for k in starts})
        readings: dict[int, Reading] = {}
        failures: dict[int, CapSenseError] = {}
        for k in starts:
            for number, found in enumerate(parts.get(k) or size * [lost[k]], k):
                if isinstance(found, Reading):
                    readings[number] = found
                else:
                    failures[number] = found
        if failures:
            raise BatchError(some_failed("scenes", failures, len(scenes)), readings, failures)
        return list(readings.values())

    def _each(self, scenes: Sequence[Scene | DepthFrame]) -> list[Reading | CapSenseError]:
        """Readings of scenes, each from rest, or what was wrong with them."""
        start = perf_counter()
        plain = [s.scene() if isinstance(s, DepthFrame) else s for s in scenes]
        try:
            solver = self._idle.popleft()
        except IndexError:
            solver = self.copy()._solver
        try:
            found = solver.solve_each(plain)
        finally:
            self._idle.append(solver)
        seconds = (perf_counter() - start) / len(plain)
        return [
            f if isinstance(f, CapSenseError) else self._of(f, scene, seconds)
            for f, scene in zip(found, plain, strict=True)
        ]

    def potentials(self, points: ArrayLike) -> Array:
        """Potentials of the last step at points in front of the sensor [V], for drawing.

        Potentials are those of the compact Green's function: right to some per cent from 2 mm in
        front of the electrodes on, and of no meaning behind them. Bodies that float are at the
        potential they take.

        Args:
            points: Points [m] in the sensor frame, shape (n, 3).

        Returns:
            Shape (n, terminals), in the order of ``background.terminals``: each at 1 V in its own
            column, all others at 0.

        Raises:
            SceneError: The points do not have shape (n, 3).
            ValueError: The method is ``"fem_masked"``, which solves on a mesh of its own.
        """
        with self._one:
            return self._solver.potentials(as_points(points))

    def charges(self) -> Charges | None:
        """Charges on the bodies of the last step, for drawing.

        Returns:
            Places and densities; None where no body was near, or with ``"fem_masked"``.
        """
        with self._one:
            return self._solver.charges()

    def copy(self) -> Simulator:
        """Another sensor of the same design and settings, at rest; the two share the field.

        It has no readout: a chip belongs to one sensor.
        """
        return Simulator(
            None if self.mesh else self.design, method=self.method, preset=self.preset,
            excitation_frequency=self.excitation_frequency, settings=self.settings,
            background=self._background, mesh=self.mesh,
        )  # fmt: skip

    def reset(self, *, seed: int | None = None, start: float = 0.0) -> None:
        """Forget the step before, from which ``"fem_masked"`` starts, and what the cover remembers
        of its contacts; restart the chip.

        Args:
            seed: Of the readout's noise from now on; by default its random numbers repeat.
            start: Time at which it is switched on [s].

        Raises:
            ReadoutError: The seed is no whole number from 0 on.
        """
        with self._one:
            self._solver.reset()
            self.steps = 0
            if self.readout is not None:
                self.readout.reset(start=start, seed=seed)

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


def _check_view(where: str, scene: object) -> None:
    if not isinstance(scene, (Scene, DepthFrame)):
        raise SceneError(
            f"{where} a Scene or a DepthFrame, not {type(scene).__name__}; write Scene([...])"
        )
