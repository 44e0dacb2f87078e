"""A sensor in a changing world: :class:`Simulator` turns scenes into readings."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from capsense._crew import Crew, some_failed
from capsense.design import load_design
from capsense.design.model import Design, Role
from capsense.errors import BatchError, FieldError, SceneError
from capsense.field.background import BackgroundField, BuildSettings
from capsense.field.boundary import terminals
from capsense.field.cache import default_settings, load_or_build
from capsense.scene import Layers, Scene, TriMesh
from capsense.scene.depth import DepthFrame

if TYPE_CHECKING:
    from capsense.readout.counts import Counts
    from capsense.solve.perturbation import PerturbationSolver
    from capsense.surface.potentials import PotentialMap
    from capsense.surface.solve_kernels import Solution
    from capsense.surface.solver import View

Array = NDArray[np.float64]
Method = Literal["surface", "perturbation", "masked"]
PresetName = Literal["standard", "learning", "fine"]


@dataclass(frozen=True)
class StepStats:
    """How a step was solved."""

    iterations: int
    """Iterations of the linear solver."""
    error_estimate: float
    """Estimated error of a capacitance that iterating on would remove [F]."""
    tolerance: float
    """What the error estimate was brought below [F]."""
    wall_time: float
    """Time the step took [s]."""
    unknowns: int = 0
    """Charge functions that were solved for; 0 where the lattice or the paper's scheme did."""


@dataclass(frozen=True, eq=False)
class Reading:
    """The capacitances of one instant."""

    capacitance: Array
    """Maxwell capacitance matrix of the electrodes, shields at ground [F], shape (M, M)."""
    delta: Array
    """Change against the empty domain, ``capacitance - baseline`` [F], shape (M, M)."""
    stats: StepStats
    electrode_names: tuple[str, ...]
    _shield_coupling: Array = field(repr=False)
    counts: Counts | None = None
    """What the chip has reported since the reading before, where a read-out is configured."""
    jacobian: Array | None = None
    """How ``capacitance`` changes as each body of the scene moves along the sensor frame's x, y, z
    [F/m], then turns about axes parallel to these through its own origin [F/rad], where it was
    asked for, shape (bodies, M, M, 6)."""

    @property
    def self_capacitance(self) -> Array:
        """What a self-mode channel measures [F], shape (M,).

        Electrode i is driven, shields are driven with it, all other electrodes are grounded:
        the diagonal of the Maxwell matrix plus the (negative) coupling to the shields.
        """
        return np.diag(self.capacitance) + self._shield_coupling

    @property
    def mutual_capacitance(self) -> Array:
        """Mutual capacitances ``-C_ij`` [F] off the diagonal, zero on it, shape (M, M)."""
        out = -self.capacitance
        np.fill_diagonal(out, 0.0)
        return out


class _Method(Protocol):
    """What a solver offers: the change of the matrix of all terminals."""

    def solve(self, scene: Scene) -> tuple[Array, int, float, float]: ...

    def reset(self) -> None: ...


class _SurfaceScenes:
    """Solves scenes by charges on the bodies, and on the lattice what has no surface charges."""

    def __init__(
        self,
        background: BackgroundField,
        frequency: float,
        preset: str,
        lattice: Callable[[], PerturbationSolver],
    ) -> None:
        from capsense.surface.solver import PRESETS, SurfaceSolver

        self.surface = SurfaceSolver(background, frequency=frequency, preset=PRESETS[preset])
        self.unknowns = 0
        self._background = background
        self._make = lattice
        self._lattice: PerturbationSolver | None = None
        self._last: Callable[[], Array] = self._nothing
        self._gradient: Callable[[], Array] | None = None
        self._map: PotentialMap | None = None

    def solve(self, scene: Scene, jacobian: bool = False) -> tuple[Array, int, float, float]:
        """Return the change, iterations, error estimate [F] and tolerance [F].

        Raises:
            SceneError: A Jacobian is asked for of what has no surface charges.
        """
        self.unknowns = 0
        self._last, self._gradient = self._nothing, None
        view = self.surface.look(scene)
        missing = self.surface.unsupported(view)
        close = 1.0 if missing else self.surface.closeness(view)
        if missing and jacobian:
            raise SceneError(f"there is no Jacobian of {missing}; only surface charges have one")
        change = np.zeros((len(self._background.terminals),) * 2)
        iterations, error, goal = 0, 0.0, 0.0
        if close < 1.0 or jacobian:
            part, error = self._on_surfaces(view, jacobian)
            change += (1.0 - close) * part
            goal = error
        if close > 0.0:
            if self._lattice is None:
                self._lattice = self._make()
            self._lattice.reset()  # a reading does not depend on the one before it
            part, iterations, left, wanted = self._lattice.solve(scene)
            change += close * part
            error, goal = max(error, left), max(goal, wanted)
            if close > 0.5:
                self._last = self._lattice.potentials
        return change, iterations, error, goal

    def _on_surfaces(self, view: View, jacobian: bool) -> tuple[Array, float]:
        """Change of the matrix of all terminals [F], and its estimated error [F]."""
        bodies, solution = self.surface.solution(view, jacobian=jacobian)
        self._gradient = partial(self.surface.jacobian, view, bodies, solution)
        if solution is None:
            return np.zeros((len(self._background.terminals),) * 2), 0.0
        self._last = partial(self._around, view, solution)
        self.unknowns = solution.size
        return self.surface.in_farads(solution)

    def potentials(self) -> Array:
        """Change of the potentials at the nodes in the last step [V], shape (n, terminals)."""
        return self._last()

    def jacobian(self) -> Array:
        """How the matrix of all terminals changes with the poses of the last scene's bodies.

        In contact with the design, where the lattice has a share in the reading, it is that of the
        surface charges alone.
        """
        assert self._gradient is not None  # asked for in ``solve``
        return self._gradient()

    def reset(self) -> None:
        """Forget the last scene; no reading depends on the one before."""
        self._last, self._gradient = self._nothing, None

    def _nothing(self) -> Array:
        return np.zeros_like(self._background.potentials)

    def _around(self, view: View, solution: Solution) -> Array:
        from capsense.surface.potentials import PotentialMap

        lattice = self._background.lattice
        if self._map is None:
            self._map = PotentialMap(self._background.green, lattice.points)
        out = self._map.change(solution)
        out[lattice.owner >= 0] = 0.0
        for place in np.flatnonzero(view.matter.conducting).tolist():
            body = view.scene[int(view.met[place])]
            if isinstance(body.shape, Layers | TriMesh):
                continue
            local = body.pose.inverse().apply(lattice.points)
            inside = (body.shape.signed_distance(local) < 0) & (lattice.owner < 0)
            if inside.any():
                held = self._background.potentials[inside]
                value = (held + out[inside]).mean(axis=0) if body.grounding != "grounded" else 0.0
                out[inside] = value - held
        return out


class Simulator:
    """Reads the capacitances of a sensor, scene after scene.

    Args:
        design: A design, a packaged name, or the path of a design file.
        method: ``"perturbation"`` (default): the change of the field on a lattice.
            ``"surface"``: charges on the surfaces of the bodies; more accurate, smooth, with
            gradients. ``"masked"``: the scheme of Schöffmann et al.
            2022, where objects are staircases of tetrahedra, solved in full.
        preset: How finely surfaces are resolved: ``"standard"``, ``"learning"`` (faster, some
            3 % rms) or ``"fine"``.
        tolerance: On the lattice, iterate until a capacitance is known to this [F] …
        relative_tolerance: … or to this fraction of the largest change, whichever is larger.
        frequency: Excitation frequency [Hz]; decides which materials conduct.
        settings: Numerical settings of the background field; default from ``design.build``.
        cache_dir: Where built fields are kept; default the user's cache directory.
        progress: Called with a stage's name and the fraction done while a field is built.
        background: The field of this design with these settings, if it is at hand; it is shared,
            not copied. :meth:`sibling` passes its own.

    Raises:
        DesignError: The design is wrong.
        FieldError: The background field could not be built, or ``background`` is of another design.
    """

    def __init__(
        self,
        design: Design | str | Path,
        *,
        method: Method = "perturbation",
        preset: PresetName = "standard",
        tolerance: float = 1e-18,
        relative_tolerance: float = 1e-5,
        frequency: float = 250e3,
        settings: BuildSettings | None = None,
        cache_dir: Path | None = None,
        progress: Callable[[str, float], None] | None = None,
        background: BackgroundField | None = None,
    ) -> None:
        for what, chosen, known in (
            ("method", method, get_args(Method)), ("preset", preset, get_args(PresetName)),
        ):  # fmt: skip
            if chosen not in known:
                raise ValueError(
                    f"{what} is {chosen!r}; choose one of {', '.join(map(repr, known))}"
                )
        for name, value in (
            ("tolerance", tolerance), ("relative_tolerance", relative_tolerance),
            ("frequency", frequency),
        ):  # fmt: skip
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value!r}; give a positive number")
        self.design = design if isinstance(design, Design) else load_design(design)
        self.method: Method = method
        self.preset: PresetName = preset
        self.tolerance, self.relative_tolerance = tolerance, relative_tolerance
        self.frequency = frequency
        self.settings = settings or default_settings(self.design)
        """Numerical settings of the background field."""
        self.steps = 0
        """Steps since the last reset, one that failed included."""
        if background is None:
            background = load_or_build(
                self.design, self.settings, cache_dir=cache_dir, progress=progress
            )
        elif background.terminals != tuple(terminals(self.design)):
            raise FieldError(
                f"the background field is of terminals {background.terminals}, but design "
                f"{self.design.name!r} has {tuple(terminals(self.design))}; leave it out"
            )
        self.background: BackgroundField = background
        """Field and online mesh of the empty domain; never changed, so that it can be shared."""
        if method == "masked":
            from capsense.solve.scene_masks import MaskedScenes

            self._solver: _Method = MaskedScenes(
                self.design, self.background, self.settings, frequency
            )
        elif method == "surface":
            self._solver = _SurfaceScenes(self.background, frequency, preset, self._on_lattice)
        else:
            self._solver = self._on_lattice()
        self._batch: list[Simulator] = []  # a sensor for each thread
        self._worlds: list[Simulator] = []  # a sensor for each scene that follows another
        n = len(self.design.electrodes)
        floating = [c.name for c in self.design.conductors if c.role == Role.FLOATING]
        names = self.background.terminals
        self._names = self.design.electrode_names
        self._electrodes = np.arange(n)
        self._floating = np.array([names.index(f) for f in floating], dtype=np.int64)
        self._shields = np.array(
            [k for k in range(n, len(names)) if names[k] not in floating], dtype=np.int64
        )
        self._empty = self._without_floating(self.background.capacitance)
        self.baseline: Array = self._empty[:n, :n].copy()
        """Maxwell matrix of the electrodes in the empty domain [F], shape (M, M)."""
        self.baseline.setflags(write=False)

    def _on_lattice(self) -> PerturbationSolver:
        from capsense.solve.perturbation import PerturbationSolver

        return PerturbationSolver(
            self.background, tolerance=self.tolerance, relative_tolerance=self.relative_tolerance,
            frequency=self.frequency,
        )  # fmt: skip

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self._names

    def step(self, scene: Scene | DepthFrame, *, jacobian: bool = False) -> Reading:
        """Return the reading of a scene or of a depth camera's view, given in the sensor frame.

        On the lattice, the solution of the previous step is the starting point.

        Args:
            scene: What stands around the sensor.
            jacobian: Whether to work out ``reading.jacobian`` as well, for half a step's time.

        Raises:
            SceneError: ``scene`` is neither a scene nor a depth frame, or has no Jacobian.
            SolveError: The solver did not reach its tolerance.
            ValueError: A Jacobian is asked for of a method that has none.
        """
        start = time.perf_counter()
        _check_view("step takes", scene)
        if jacobian and not isinstance(self._solver, _SurfaceScenes):
            raise ValueError(f'method {self.method!r} has no Jacobian; use "surface"')
        if isinstance(scene, DepthFrame):
            scene = scene.scene()
        self.steps += 1
        if isinstance(self._solver, _SurfaceScenes):
            change, iterations, error, goal = self._solver.solve(scene, jacobian)
        else:
            change, iterations, error, goal = self._solver.solve(scene)
        whole = self.background.capacitance + change
        if len(self._floating):
            change = self._without_floating(whole) - self._empty
        n = len(self._electrodes)
        total = self._empty + change
        delta = change[:n, :n]
        stats = StepStats(
            iterations, error, goal, time.perf_counter() - start,
            getattr(self._solver, "unknowns", 0),
        )  # fmt: skip
        slope = self._slope(whole) if jacobian else None
        return Reading(
            self.baseline + delta, delta.copy(), stats, self._names, total[:n, n:].sum(axis=1),
            jacobian=slope,
        )  # fmt: skip

    def _slope(self, whole: Array) -> Array:
        """Jacobian of the electrodes' matrix, the design's floating conductors eliminated."""
        assert isinstance(self._solver, _SurfaceScenes)
        slope = self._solver.jacobian()
        n = len(self._electrodes)
        if len(self._floating):
            own = whole[np.ix_(self._floating, self._floating)]
            follow = np.eye(len(whole))[:, self._electrodes]
            cross = whole[np.ix_(self._floating, self._electrodes)]
            follow[self._floating] = -np.linalg.solve(own, cross)
            return np.einsum("ai,bacm,cj->bijm", follow, slope, follow)
        return slope[:, :n, :n]

    def step_batch(
        self,
        scenes: Sequence[Scene | DepthFrame],
        *,
        threads: int | None = None,
        warm_start: bool = False,
    ) -> list[Reading]:
        """Return the readings of many scenes, each solved on whichever thread is free.

        Readings do not depend on the number of threads, nor on what stands beside them in the
        batch. By default scenes have nothing to do with each other: a reading is that of
        :meth:`reset` and :meth:`step`, to the last bit. With ``warm_start``, scene k follows scene
        k of the last such batch, as in environments that are stepped together: a reading is that
        of a sensor of its own that steps from one to the next. This takes a third of the iterations
        and some memory for each scene, 0.8 MB with ``six_patch``, kept until :meth:`reset`. This
        sensor's own last step and count stay as they are.

        Args:
            scenes: Scenes or depth frames, in the sensor frame.
            threads: How many threads solve; by default as many as the process may use processors.
            warm_start: Start from the solution of the scene before.

        Raises:
            SceneError: Something in ``scenes`` is neither a scene nor a depth frame, or
                ``threads`` is not a positive whole number.
            BatchError: Some scenes failed; it holds the readings of the others.
        """
        for number, scene in enumerate(scenes):
            _check_view(f"scenes[{number}]: a batch holds", scene)
        crew = Crew(threads)
        sensors = self._worlds if warm_start else self._batch
        wanted = len(scenes) if warm_start else min(crew.threads, len(scenes))
        while len(sensors) < wanted:
            sensors.append(self.sibling())
        idle = deque(sensors)

        def from_rest(scene: Scene | DepthFrame) -> Reading:
            sensor = idle.popleft()
            try:
                sensor.reset()
                return sensor.step(scene)
            finally:
                idle.append(sensor)

        solvers = [s.step for s in sensors] if warm_start else [from_rest] * len(scenes)
        readings, failures = crew.run(
            {k: partial(solvers[k], scene) for k, scene in enumerate(scenes)}
        )
        if failures:
            raise BatchError(some_failed("scenes", failures, len(scenes)), readings, failures)
        return list(readings.values())

    def potentials(self) -> Array:
        """Potentials of the last step at the nodes of ``background.lattice`` [V].

        Returns:
            Shape (n, terminals), in the order of ``background.terminals``: each at 1 V in its own
            column, all others at 0. Where charges on surfaces were solved for, floating bodies are
            at the potential they take; on the lattice they are at 0, as all conducting bodies.

        Raises:
            ValueError: The method is ``"masked"``, which solves on another mesh.
        """
        from capsense.solve.perturbation import PerturbationSolver

        if isinstance(self._solver, _SurfaceScenes | PerturbationSolver):
            return self.background.potentials + self._solver.potentials()
        raise ValueError('method "masked" gives no potentials; use "perturbation" or "surface"')

    def sibling(self) -> Simulator:
        """Another sensor of the same design and settings, at rest; the two share the field."""
        return Simulator(
            self.design, method=self.method, preset=self.preset, tolerance=self.tolerance,
            relative_tolerance=self.relative_tolerance, frequency=self.frequency,
            settings=self.settings, background=self.background,
        )  # fmt: skip

    def reset(self) -> None:
        """Forget the previous step, and the scenes of batches that followed each other."""
        self._solver.reset()
        self._worlds.clear()
        self.steps = 0

    def describe(self) -> dict[str, float | int | str]:
        """Return the figures of the design's mesh and field."""
        la = self.background.lattice
        return {
            "design": self.design.name,
            "electrodes": len(self.design.electrodes),
            "method": self.method,
            "boundary panels": self.background.n_panels,
            "lattice": " + ".join("x".join(str(n) for n in s.shape) for s in la.storeys),
            "nodes": la.n_nodes,
            "links": int((la.weights > 0).sum()),
            "tetrahedra": la.n_tets,
            "cut links": len(la.cuts),
        }

    def _without_floating(self, matrix: Array) -> Array:
        """Eliminate the design's floating conductors; electrodes and shields remain."""
        keep = np.concatenate([self._electrodes, self._shields])
        inner = matrix[np.ix_(keep, keep)]
        if not len(self._floating):
            return inner
        cross = matrix[np.ix_(keep, self._floating)]
        own = matrix[np.ix_(self._floating, self._floating)]
        return inner - cross @ np.linalg.solve(own, cross.T)


def _check_view(where: str, scene: object) -> None:
    if not isinstance(scene, (Scene, DepthFrame)):
        raise SceneError(
            f"{where} a Scene or a DepthFrame, not {type(scene).__name__}; write Scene([...])"
        )
