"""The surface core: charges on the bodies, against the Green's function of the design."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.constants import UNIT
from capsense.design.model import Design
from capsense.errors import CapSenseError, SceneError, SolveError
from capsense.field.face import sheet_on_face
from capsense.field.face_kernels import WALL_EDGE
from capsense.field.green import GreenFunction
from capsense.field.green_kernels import pack_green
from capsense.field.green_points import narrowest_width
from capsense.field.panels import PLANE_TOL
from capsense.reading import CapacitanceChange, Charges
from capsense.scene import Body, Scene, TriMesh
from capsense.scene.contact import TOUCH, Sheets
from capsense.scene.geometry_kernels import overlapping
from capsense.scene.materials import ties_of
from capsense.scene.shapes import Shape, ShapeKind
from capsense.solver.bodies.panels import longer, windowed
from capsense.solver.gap.gap_kernels import extent_of_body
from capsense.solver.gap.touch import CoverContact, Pressed
from capsense.solver.gap.touch_kernels import no_foundation
from capsense.solver.packing import (
    BodyTemplate,
    PackedBodies,
    View,
    layer_of,
    make_template,
    same,
)
from capsense.solver.system.lossy import solve_lossy
from capsense.solver.system.network_kernels import tie_what_is_outside
from capsense.solver.system.step import (
    DIFFERENCE,
    Solution,
    potential_change,
    slopes_of,
    solve,
    solve_each,
)
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.matter import Matter, matter_of, sizes_of
from capsense.solver.tree.rigid import BODY, RigidShape
from capsense.solver.tree.shape_cache import functions_of

Array = NDArray[np.float64]


_OF_MANY = 0.4
"""Panels of one part of a large mesh, over those of a body."""
_COMMON = 0.3
"""Share of what bodies change that is in doubt where a dielectric lies within another's bounds."""
_NO_SOLUTION = "the system matrix is singular; do two bodies coincide?"
_LARGE = 0.4
"""Meshes that are longer than this [m] are solved for part by part."""
_SAME = 1e-6
"""Bounding boxes are the same that differ by less than this part of their size."""
_LAYOUTS = 32
"""So many layouts of bodies are kept."""
_NARROW = 8e-3
"""Electrodes count as at least so wide [m]: fields of narrower ones reach bodies as a mean."""


@dataclass(frozen=True)
class Preset:
    """How finely a scene is resolved."""

    panels: int = 700
    """About how many panels cover a round shape; others have more."""
    threshold: float = 0.015
    """Charge functions count that take up this part of an electrode's energy alone."""
    width: float = 2.5
    """They fade in up to so many times that."""
    coarsest: float | None = 0.5
    """Bodies get panels of a few millimetres where these would be wider on average than so much of
    the electrodes' width, and where they are wide themselves; None for never."""
    finest: float | None = 4e-3
    """Panels of other bodies have parts where they are longer than this [m]; None for none."""


PRESETS = {
    "fast": Preset(panels=300, threshold=0.05, coarsest=0.95, finest=None),
    "standard": Preset(),
    "fine": Preset(panels=1000, threshold=0.004, coarsest=0.44, finest=3e-3),
}
"""Presets by name."""


_RESOLVED, _SMOOTH = 0.6, 1.2
"""Parts of panels are no longer than the first, over the width of the narrowest electrode; nor
shorter than the second, over the validity distance: bodies come no nearer."""


@cache
def _keep_memory() -> None:
    """Let the memory that a step frees stay with the process for the next step.

    glibc gives freed memory back to the system from 128 kB on, until a program has freed a larger
    block: from then on it keeps what is smaller than that, up to 32 MB. Where a step takes
    megabytes, half of its time went to fetching them anew. Other libraries are not affected.
    """
    np.empty((32 << 20) - 8192, np.uint8)


def _turned(axis: int, angle: float) -> Array:
    """Rotation matrix about one of the axes [rad]."""
    out, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    out[i, i] = out[j, j] = math.cos(angle)
    out[j, i] = math.sin(angle)
    out[i, j] = -out[j, i]
    return out


@dataclass(frozen=True, eq=False)
class SolvedField:
    """Potentials and charges of a scene that was solved."""

    function: GreenFunction
    """Of the design."""
    length: float
    """Length that kernels take for one [m]."""
    terminals: int
    """How many there are."""
    last: tuple[View, Solution] | None
    """The scene and its solution; None where no body was near."""

    def potentials(self, points: Array) -> Array:
        """Potentials at points [V], shape (n, 3) -> (n, terminals)."""
        out = np.clip(self.function.phi0(points), 0.0, 1.0)
        if self.last is None:
            return out
        view, solution = self.last
        function = replace(self.function, unit=1.0)
        out += potential_change(function, solution, points / self.length)
        for place in np.flatnonzero(view.matter.conducting).tolist():
            body = view.scene[int(view.met[place])]
            if body.shape.kind in (ShapeKind.MESH, ShapeKind.LAYERS):
                continue
            inside = body.shape.signed_distance(body.pose.inverse().apply(points)) < 0
            if inside.any():
                out[inside] = 0.0 if body.grounding == "grounded" else out[inside].mean(axis=0)
        return out

    def charges(self) -> Charges | None:
        """Charges on the bodies; None where there are none."""
        if self.last is None:
            return None
        _, solution = self.last
        area = np.maximum(solution.extent, 1e-9)[:, None] ** 2
        density = UNIT / self.length * np.abs(solution.charge[:, : self.terminals]) / area
        points, pitch = solution.points.mean(axis=1), float(np.median(solution.extent))
        return Charges(self.length * points, density, self.length * pitch)


class SurfaceSolver:
    """Solves scenes, each by itself.

    Args:
        green: Green's function of the design.
        design: The design.
        excitation_frequency: Excitation frequency [Hz].
        preset: How finely scenes are resolved.
    """

    together = 32
    """How many scenes of a batch a thread takes at a time, at most."""

    def __init__(
        self,
        green: GreenFunction,
        design: Design,
        *,
        excitation_frequency: float = 250e3,
        preset: Preset | None = None,
    ) -> None:
        _keep_memory()
        self.excitation_frequency = excitation_frequency
        self.preset = preset or Preset()
        self.length = green.unit
        """Length that kernels take for one [m]: all of theirs are ratios to the electrodes."""
        self.unit = UNIT * self.length
        """What they take for a capacitance of one [F]."""
        metres = design
        design = metres.in_units if self.length == metres.unit else metres
        self.green = pack_green(green, design)
        self._function = green
        self._groundless = design.ground_capacitance is not None and not design.local_ground
        walls = np.array([design.domain.lower, design.domain.upper])
        self.middle, self.reach = walls.mean(axis=0), float(np.linalg.norm(np.ptp(walls, axis=0)))
        """Middle and diagonal of the domain, over ``length``, as :func:`windowed` takes them."""
        self._sight = self.green.active_bounds + WALL_EDGE * self.green.extent * np.array(
            [[-1.0], [1.0]]
        )
        """Corners of the box beyond which no charge is, over ``length``, shape (2, 3)."""
        self._last: tuple[View, Solution] | None = None
        self._laid: dict[tuple[Matter | Shape, ...], BodyTemplate] = {}
        """The last layouts, by the matter and the shapes of the bodies, which they hold."""
        gap = self.green.gap
        self.touch = self.length * (gap.least if len(gap.areas) else TOUCH)
        """What is nearer to an electrode than this [m] touches it."""
        self._contact = (
            CoverContact(design.cover, [e.surface for e in design.electrodes], self.length)
            if design.cover is not None
            else None
        )
        self.cover = no_foundation() if self._contact is None else self._contact.foundation
        """The cover as kernels take it; without pressures where there is none."""
        bare = [
            m.surface.triangles
            for m, e in zip(metres.electrodes, design.electrodes, strict=True)
            if not len(gap.areas)
            or sheet_on_face(design, e.name).bounds[1, 2] > gap.top - PLANE_TOL
        ]
        self._sheets = Sheets(bare, self.touch) if bare else None
        coarsest, width = self.preset.coarsest, narrowest_width(design)
        self._largest = coarsest and self.preset.panels * (coarsest * max(width, _NARROW)) ** 2
        """Bodies of so much surface or more, over ``length``², get small panels; None for none."""
        finest = self.preset.finest
        if finest is not None:
            finest = min(finest, _RESOLVED * width)
            finest = max(finest, _SMOOTH * self.green.gap.validity)
        self._finest = finest
        """Panels of other bodies have parts where they are longer, over ``length``; None for none.
        """

    def __getstate__(self) -> dict[str, Any]:
        """Copies lay bodies out anew, as records point to arrays, and take no shapes along."""
        return self.__dict__ | {"_laid": {}}

    def solve(
        self, scene: Scene, *, jacobian: bool = False, time: float | None = None
    ) -> CapacitanceChange:
        """Return what a scene changes; ``time`` [s] is what a cover's relaxation follows.

        Raises:
            SceneError: A Jacobian is requested for bodies that have none.
            SolveError: Bodies lie within each other in a way that leaves no solution.
        """
        view = self.look(scene)
        self._last = None
        bodies, solution = self.solution(view, jacobian=jacobian, time=time)
        slope = self.jacobian(view, bodies, solution) if jacobian else None
        if solution is None:
            change = self._change(view, bodies, np.zeros((self.green.terminals,) * 2), 0.0, 0)
            return replace(change, jacobian=slope)
        self._last = view, solution
        matrix, error = self.unit * solution.delta, self.unit * solution.error
        change = self._change(view, bodies, matrix, error, solution.size)
        return replace(change, jacobian=slope, reason=partial(self._reason, view, bodies, solution))

    def _reason(self, view: View, bodies: PackedBodies, solution: Solution) -> str:
        """What most of the estimated error comes from, in words."""
        if self._fills(view):
            return (
                "a dielectric lies within another one, and the charges of a face that they share "
                "are not resolved; solve for one body of the outer shape instead"
            )
        if solution.shift > 0.0:
            return "bodies lie within each other or within the sensor"
        close = f"nearer than {2e3 * self.length * self.green.gap.validity:.2g} mm"
        if (solution.near & (bodies.records["inverse_susceptibility"] != 0.0)).any():
            return f"what a dielectric adds that is {close} is only estimated there"
        if solution.near.any():
            return f"a conductor is {close}, and its panels are coarse for that"
        return f"{solution.size} charge functions resolve it, and more would change it"

    def _change(
        self, view: View, bodies: PackedBodies, matrix: NDArray[Any], error: float, size: int
    ) -> CapacitanceChange:
        """What a scene changes, by its matrix [F] and the error of that."""
        if self._fills(view):
            error = max(error, _COMMON * float(np.abs(matrix).max()))
        if self._meets_electrodes(view):
            error = math.inf
        loss = -matrix.imag if np.iscomplexobj(matrix) else None
        return CapacitanceChange(matrix.real, error, unknowns=size, loss=loss, touch=bodies.touch)

    def solve_each(self, scenes: Sequence[Scene]) -> list[CapacitanceChange | CapSenseError]:
        """Return what each of many scenes changes, or what was wrong with it.

        Results are those of :meth:`solve`; those without losses are solved in one call.
        """
        out: dict[int, CapacitanceChange | CapSenseError] = {}
        plain: list[tuple[int, View, PackedBodies]] = []
        for k, scene in enumerate(scenes):
            try:
                view = self.look(scene)
                if view.matter.lossy:
                    out[k] = self.solve(scene)
                else:
                    plain.append((k, view, self.pack(view)))
            except CapSenseError as error:
                out[k] = error
        if plain:
            first = np.cumsum([0, *(len(bodies.records) for _, _, bodies in plain)])
            records = np.empty(first[-1], BODY)  # numpy takes 10 µs for each to concatenate them
            for (_, _, bodies), start, end in zip(plain, first, first[1:], strict=False):
                records[start:end] = bodies.records
            delta, doubt, size = solve_each(
                records, first, self.green, self.preset.threshold, self.preset.width
            )
            delta, doubt = self.unit * delta, self.unit * doubt
            sound = np.isfinite(delta).all(axis=(1, 2))
            for i, (k, view, bodies) in enumerate(plain):
                if sound[i]:
                    out[k] = self._change(view, bodies, delta[i], float(doubt[i]), int(size[i]))
                else:
                    out[k] = SolveError(_NO_SOLUTION)
        return [out[k] for k in range(len(scenes))]

    @staticmethod
    def _fills(view: View) -> bool:
        """Whether a dielectric lies within the bounding box of another, as water in a glass.

        At a face of two dielectrics the charges of both nearly cancel. Clusters of different bodies
        meet each other as four points, which leave as much of a gap between them.
        """
        places = np.flatnonzero(~view.matter.conducting)
        if len(places) < 2:
            return False
        low, high = view.packed.bounds[view.met[places]].transpose(1, 0, 2)
        grain = _SAME * (high - low).max()
        inside = (low[:, None] >= low - grain) & (high[:, None] <= high + grain)
        return int(inside.all(axis=2).sum()) > len(places)

    def _meets_electrodes(self, view: View) -> bool:
        """Whether an electrode lies inside a body, or touches a conductor.

        Covered electrodes are not touched: what overlaps their cover is pressed onto it.
        """
        if self._sheets is None:
            return False
        near = set(overlapping(view.packed.bounds, *self._sheets.bounds).tolist())
        return bool(near) and any(
            self._sheets.meet(view.scene[k], bool(view.matter.conducting[place]))
            for place, k in enumerate(view.met.tolist())
            if k in near
        )

    def field(self) -> SolvedField:
        """What the last scene did to the field; it stays when other scenes are solved."""
        return SolvedField(self._function, self.length, self.green.terminals, self._last)

    def reset(self) -> None:
        """Forget the last scene, and what covers remember of their contacts."""
        self._last = None
        if self._contact is not None:
            self._contact.reset()

    def look(self, scene: Scene) -> View:
        """Find the bodies of a scene that reach into the domain, and what they are made of.

        Of conductors that are not at ground, and of those that touch these, all parts count, also
        those outside of the domain: a person's other limbs.
        """
        packed = scene.pack()
        met = overlapping(packed.bounds, *(self.length * self._sight))
        matter = self.matter_of(list(scene))
        if not (matter.some_free and len(met)):
            return View(scene, packed, met, matter.repeated(met.tolist()))
        used = np.union1d(met, np.flatnonzero(matter.free))
        joined = matter.repeated(used.tolist()).joined(scene, packed, used)
        seen = np.isin(used, met)
        seen |= joined.free & np.isin(joined.group, joined.group[seen])
        places = np.flatnonzero(seen)
        return View(scene, packed, used[places], joined.repeated(places.tolist()))

    def matter_of(self, bodies: Sequence[Body]) -> Matter:
        """What bodies are made of, with lengths as kernels take them."""
        local = self.green.local >= 0
        matter = matter_of(bodies, self.excitation_frequency, self.length, local=local)
        if self._groundless and any(ties_of(body.grounding)[1] > 0.0 for body in bodies):
            raise SceneError(
                "a body is tied to the local ground, which floats and has no conductor; give the "
                'design a [[conductor]] of role = "ground", or the body another grounding'
            )
        if matter.local is not None and matter.lossy:
            raise SceneError(
                "a body is tied to the local ground, which floats, beside matter with losses; give "
                "bodies a conductor's or a lossless material, or other groundings"
            )
        return matter

    def solution(
        self, view: View, *, jacobian: bool = False, time: float | None = None
    ) -> tuple[PackedBodies, Solution | None]:
        """Return the packed bodies of a scene and their charges; None where none is in the domain.

        Raises:
            SolveError: Bodies lie within each other in a way that leaves no solution.
        """
        bodies, preset = self.pack(view, time), self.preset
        if not len(bodies.records):
            return bodies, None
        matter = bodies.matter
        if matter.lossy:
            ties = matter.ties(sizes_of(bodies.records, bodies.shapes))
            free = (bodies.records["free"] > 0.0) & (bodies.records["neutral"] == 0)
            ties = np.where(free, bodies.records["ground_elastance"], ties)
            out = solve_lossy(
                bodies.records, ties, matter.inverse_susceptibility, self.green,
                preset.threshold, preset.width,
            )  # fmt: skip
        else:
            out = solve(bodies.records, self.green, preset.threshold, preset.width, jacobian)
        if not np.isfinite(out.delta).all():
            raise SolveError(_NO_SOLUTION)
        return bodies, out

    def jacobian(self, view: View, bodies: PackedBodies, solution: Solution | None) -> Array:
        """How the matrix of all terminals changes with the poses of a scene's bodies.

        Returns:
            Shape (bodies, terminals, terminals, 6): as each body moves along the sensor frame's x,
            y, z [F/m], and turns about axes parallel to these through its origin [F/rad].

        Raises:
            SceneError: A body is of matter with losses.
        """
        out = np.zeros((len(view.scene), self.green.terminals, self.green.terminals, 6))
        if solution is None:
            return out
        if bodies.matter.lossy:
            raise SceneError(
                "a Jacobian is asked for with bodies of lossy matter, which have none yet; give "
                "them a conductor's or a lossless material"
            )
        preset = self.preset
        slope = UNIT * slopes_of(
            solution, bodies.records, self.green, preset.threshold, preset.width
        )
        slope[..., 3:] += np.cross(bodies.offsets[:, None, None], slope[..., :3])
        slope[..., 3:] *= self.length
        np.add.at(out, bodies.chosen, slope)
        for pressed in bodies.pressed:
            if pressed.held:
                out[bodies.chosen[pressed.rows[0]]] = self._held_slope(bodies, pressed)
        return out

    def _held_slope(self, bodies: PackedBodies, pressed: Pressed) -> Array:
        """As :meth:`jacobian`, of one body that a force holds, (terminals, terminals, 6).

        Central differences of the step; the force stays the same, so that z does not count.
        """
        assert self._contact is not None
        out = np.zeros((self.green.terminals, self.green.terminals, 6))
        rows, preset = pressed.rows, self.preset
        start = bodies.records[rows].copy()
        start["position"][:, 2] += pressed.depth
        origin = start["position"] - bodies.offsets[rows]
        step = DIFFERENCE * self.green.gap.validity
        arm = max(step, *(extent_of_body(record) for record in start))
        for way in (0, 1, 3, 4, 5):
            change = step if way < 3 else step / arm
            found = []
            for sign in (1.0, -1.0):
                moved = start.copy()
                if way < 3:
                    moved["position"][:, way] += sign * change
                else:
                    turn = _turned(way - 3, sign * change)
                    moved["rotation"] = turn @ start["rotation"]
                    moved["position"] = origin + (start["position"] - origin) @ turn.T
                self._contact.lower(moved, pressed)
                records = bodies.records.copy()
                records[rows] = moved
                found.append(
                    solve(records, self.green, preset.threshold, preset.width, False).delta
                )
            out[..., way] = UNIT * (found[0] - found[1]) / (2.0 * change)
        out[..., 3:] *= self.length
        return out

    def pack(self, view: View, time: float | None = None) -> PackedBodies:
        """Lay out the bodies that reach into the domain, pressed into the cover if there is one."""
        matter, packed = view.matter, view.packed
        bodies = [packed.shapes[k] for k in view.met.tolist()]
        offsets: list[tuple[int, Array]] = []
        key = matter, *bodies
        laid = self._laid.get(key)
        if laid is None or not laid.everywhere:
            laid, offsets = self._lay_out(view, matter, bodies, laid)
            if len(self._laid) >= _LAYOUTS or not laid.rigid:  # what changes is not kept
                self._laid.clear()
            self._laid[key] = laid
        records, chosen = laid.copied(), view.met[laid.places]
        records["rotation"] = rotation = packed.rotation[chosen]
        records["position"] = packed.position[chosen] / self.length
        shift = np.zeros((len(chosen), 3))
        for i, at in offsets:
            shift[i] = rotation[i] @ at
            records["position"][i] += shift[i]
        tie_what_is_outside(records, self.green.space)
        out = PackedBodies(records, chosen, laid.matter, laid.shapes, shift)
        if not laid.rigid:
            out.refit(self.green, math.inf if self._finest is None else self._finest)
        if self._contact is None:
            return out
        touch, pressed = self._contact.press(records, chosen, view.scene.bodies, time)
        return replace(out, touch=touch, pressed=pressed)

    def _lay_out(
        self, view: View, matter: Matter, bodies: list[Shape], laid: BodyTemplate | None
    ) -> tuple[BodyTemplate, list[tuple[int, Array]]]:
        """Records of the bodies, and where parts of them stand in their frames [m], if not at 0.

        ``laid`` is what was found of them when they stood elsewhere.
        """
        found: list[tuple[RigidShape | DynamicBody, float]] = []
        solved: list[Shape] = []
        places: list[int] = []
        offsets: list[tuple[int, Array]] = []
        conducting = view.matter.conducting.tolist()
        for place in range(len(view.met)):
            parts, share, at = self._parts(view, place)
            if at is not None:
                offsets.append((len(places), at))
            for part in parts:
                made = self.functions_of(part, conducting[place], share)
                for body in (made, *layer_of(part, conducting[place])):
                    found.append(body)
                    solved.append(part)
                    places.append(place)
        if laid is None or (laid.places, laid.found) != (places, found):
            laid = make_template(matter, places, found)
        whole = [body.measured_in(self.length) for body in bodies]
        return replace(laid, everywhere=same(solved, whole)), offsets

    def _parts(self, view: View, place: int) -> tuple[Sequence[Shape], float, Array | None]:
        """Parts of a body to be solved for.

        Long bodies are cut, see :func:`windowed`. Each connected part of a large mesh has charge
        functions of its own, if it reaches into the domain; current between them is not followed,
        so that lossy meshes stay whole.

        Returns:
            Parts, the share of the usual panels that each is given, and where the only one is in
            the body's frame if that is not its origin; over ``length``.
        """
        k, matter = int(view.met[place]), view.matter
        shape = view.packed.shapes[k].measured_in(self.length)
        position = view.packed.position[k] / self.length
        if not isinstance(shape, TriMesh):
            if not longer(shape, self.reach):
                return (shape,), 1.0, None
            middle = (self.middle - position) @ view.packed.rotation[k]
            part, at = windowed(shape, middle, self.reach)
            return (part,), 1.0, at
        if (
            np.ptp(shape.bounds(), axis=0).max() < _LARGE
            or not (matter.conducting[place] or matter.eps[place].imag == 0)
            or shape.parts == 1
        ):
            return (shape,), 1.0, None
        rotation = view.packed.rotation[k]
        low, high = shape.piece_bounds
        middle = position + 0.5 * (low + high) @ rotation.T
        half = 0.5 * (high - low) @ np.abs(rotation.T)
        low, high = self._sight
        near = ((middle + half > low) & (middle - half < high)).all(axis=1)
        return [shape.pieces[i] for i in np.flatnonzero(near).tolist()], _OF_MANY, None

    def functions_of(
        self, shape: Shape, conducting: bool, share: float = 1.0
    ) -> tuple[RigidShape | DynamicBody, float]:
        """Charge functions of a body from a share of the usual panels, and its size; its lengths
        are over ``length``."""
        panels = round(share * self.preset.panels)
        return functions_of(
            shape, panels, conducting=conducting, largest=self._largest, finest=self._finest
        )
