"""A fleet's step on Warp: the workspace of the kernels, and their launches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.errors import SceneError
from capsense.field.background import Terminals
from capsense.field.soft import BODY
from capsense.fleet import warp_charges as charges
from capsense.fleet import warp_cut, warp_fabric, warp_gap, warp_near, warp_slope, warp_touch
from capsense.fleet import warp_network as network
from capsense.fleet import warp_pairs as pairs
from capsense.fleet import warp_solve as solution
from capsense.fleet.bodies import Bodies, on_device
from capsense.fleet.chips import ChipsOfSensors
from capsense.fleet.warp_chips import WarpChips, registers
from capsense.fleet.warp_outline import pack_outlines
from capsense.fleet.warp_pack import pack_circuit, pack_response, pack_shapes
from capsense.reading import FleetTouch
from capsense.readout import Readout
from capsense.readout.conversions import Held
from capsense.solver.gap.touch_kernels import COARSE, FINE
from capsense.solver.surface_solver import SurfaceSolver
from capsense.solver.tree.rigid import RigidShape

Array = NDArray[np.float64]

_NODES = 8
"""At most so many conductors near a design that are not at ground are nodes in each view."""


class WarpCore:
    """Solves views, each sensor in each environment one.

    Args:
        solver: Knows the design.
        terminals: Of the design.
        counts: How many environments, places for bodies, and sensors.
        clusters: Into how many clusters a body is cut.
        device: Warp's device.
    """

    def __init__(
        self, solver: SurfaceSolver, terminals: Terminals, counts: tuple[int, int, int],
        clusters: int, device: Any,
    ) -> None:  # fmt: skip
        self.device, self.counts, self._taken = device, counts, 0
        self._slopes: list[Any] | None = None
        self._fabric_slopes: Any = None
        self.shapes: Any = None
        self._before: list[Any] = []
        self._captured = False
        environments, places, sensors = counts
        table = warp_near.law_of(solver.green)
        slots = min(places, _NODES) if len(table.areas) else 0
        self.green = pack_response(solver, slots, device)
        self.circuit = pack_circuit(solver, terminals, device)
        self.circuit.omega = 2 * np.pi * solver.excitation_frequency
        self.gap = warp_near.pack_gap(solver.green, table, slots, device)
        self.outlines: Any = None
        views, n, m = environments * sensors, places * clusters, terminals.electrodes
        passes, t, phi_columns = (
            self.green.table.shape[1],
            self.green.terminals,
            self.green.phi_columns,
        )
        size, chunks = t + slots, len(self.gap.owner)
        width, room, struct = passes * warp_cut.WIDTH, self.room, self._struct
        self.cut = struct(
            warp_cut.WarpActiveTree,
            {
                "split number score part mix weight panel_end_fraction out": (n, views),
                "node lifted extent softening_length barrier": (3 * n, views),
                "outside_fraction near points unlifted": (3 * n, views),
                "pose moved leader ground_elastance slot outside": (places, views),
                "lossy width walled columns": (views,),
            },
        )
        self.cut.clusters = clusters
        self.left = struct(
            solution.Left,
            {
                "charge on residual": (n, 2 * phi_columns, views),
                "sums": (width - self.green.first, 2 * phi_columns, views),
                "strength": (len(self.green.sources), 2 * phi_columns, views),
                "energy": (n, views),
                "doubt": (size, views),
                "dropped": (views,),
                "below": (size, size, views),
                "volts": (slots, t, views),
            },
        )
        self.near = struct(warp_near.NearBodies, {
            "count": (views,), "body below sunk foot": (places, views),
            "depth": (chunks, places, views),
            "capacitance": (slots, views),
            "part": (chunks, table.columns.shape[1] + slots, views),
        })  # fmt: skip
        self.places = struct(
            warp_cut.Places,
            {
                "choice neutral inverse_susceptibility ground_elastance scale slack": (
                    environments,
                    places,
                ),
                "hidden": (sensors, places),
                "group": (places,),
            },
        )
        for name in ("scale", "inverse_susceptibility", "group"):
            setattr(self.near, name, getattr(self.places, name))
        for name in ("pose", "slot", "columns", "lossy"):
            setattr(self.near, name, getattr(self.cut, name))
        self.near.sensors = sensors
        self.own_forces, self.forces = room(environments, places), room(environments, places)
        """Normal forces that bodies have themselves, and those of a step [N], NaN for none."""
        self.touch = self._touch(solver, m)
        """What is pressed onto the cover, None without one; written anew by each step."""
        self.fabric = self._fabric(solver)
        self.solved = room(n, size, views)
        self.rows, self.matrix = room(n, width, views), room(n, n, views)
        self.loss, self.quadrature = room(n, views), room(n, size, views)
        self.whole = room(size, size, views, dtype=wp.vec2d)
        self.capacitance, self.delta, self.conductance = (
            room(environments, sensors, m, m) for _ in range(3)
        )
        self.shields = room(environments, sensors, m, dtype=wp.float64)
        self.error = room(environments, sensors)
        self.poses = room(environments, places, dtype=wp.transform)
        self.frames = room(environments, sensors, dtype=wp.transform)
        self.worlds = wp.clone(self.frames)
        """Frames of sensors that are those of the worlds."""
        self.worlds.fill_(wp.transform_identity())
        self.due, self.some = (room(environments, dtype=wp.int32) for _ in range(2))
        """Marks of environments to be solved: all of them, and those of a step of some."""
        self.due.fill_(1)
        n = terminals.electrodes
        for out, empty in (
            (self.capacitance, terminals.empty[:n, :n]),
            (self.shields, terminals.empty[:n, n:].sum(axis=1)),
        ):
            out.assign(np.broadcast_to(empty, out.shape))

    def room(self, *shape: int, dtype: Any = wp.float32) -> Any:
        """An array of zeros on the device."""
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _struct(self, kind: Any, shapes: dict[str, tuple[int, ...]]) -> Any:
        """A structure whose arrays, here by name, are zeros on the device."""
        out = kind()
        for names, shape in shapes.items():
            for name in names.split():
                setattr(out, name, self.room(*shape, dtype=kind.vars[name].type.dtype))
        return out

    def _touch(self, solver: SurfaceSolver, electrodes: int) -> FleetTouch | None:
        """Allocate arrays for the contact mechanics of the cover, if the design has one."""
        if not len(solver.cover.strain):
            return None
        environments, places, sensors = self.counts
        self.foundation = warp_touch.pack_foundation(solver.cover, solver.length, self.device)
        below = places, environments * sensors
        self.contacts = self._struct(warp_touch.CoverContacts, {
            "active force grid least depth elastic": below, "height": (FINE * FINE, *below),
        })  # fmt: skip
        each = environments, sensors, electrodes
        return FleetTouch(self.room(*each), self.room(*each), self.room(*each[:2]))

    def _fabric(self, solver: SurfaceSolver) -> Any:
        """Allocate arrays for a conducting fabric on the cover, if the design has one."""
        soft = solver.green.gap.soft
        if soft.top == BODY:
            return None
        environments, places, sensors = self.counts
        views = environments * sensors
        self.pressed = self._struct(warp_fabric.FabricState, {
            "touches": (places, views), "pressed cell depth": (len(soft.sheet_areas), views),
            "count": (views,),
        })  # fmt: skip
        return warp_fabric.pack_fabric(soft, self.device)

    def take(self, bodies: Bodies, shapes: Sequence[RigidShape], forces: Array) -> None:
        """Take over what stands where, in the memory that there is; new shapes take new memory.

        ``forces`` are those that press bodies onto the cover [N], NaN for none, shape (e, b).
        Where a step was captured, what was there before stays for it; it reads NaN from then on.
        """
        if len(bodies.shapes) != self._taken:
            if self._captured:
                self._captured = False
                before = self.places.choice, self.circuit.empty_maxwell, self.circuit.empty
                self._before.append((self.shapes, self.outlines, *before))
                self.places.choice = wp.clone(before[0])
                self.circuit.empty_maxwell, self.circuit.empty = map(wp.clone, before[1:])
                for matrix in before[1:]:
                    matrix.fill_(np.nan)
            self.shapes, self._taken = pack_shapes(shapes, bodies, self._array), len(bodies.shapes)
            self.outlines = pack_outlines(shapes, self._array)
            self.near.choice, self.near.radius = self.places.choice, self.shapes.radius
        for name in ("choice", "neutral", "hidden", "group"):
            getattr(self.places, name).assign(getattr(bodies, name).astype(np.int32))
        for name in ("scale", "slack"):
            getattr(self.places, name).assign(getattr(bodies, name).astype(np.float32))
        for name in ("inverse_susceptibility", "ground_elastance"):
            both = getattr(bodies, name).astype(np.complex64).view(np.float32)
            getattr(self.places, name).assign(both.reshape(*bodies.scale.shape, 2))
        self.own_forces.assign(forces.astype(np.float32))

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def mask(self, environments: Any) -> Any:
        """A mask of environments on the device, as an array of Warp.

        Raises:
            SceneError: It is of another shape or type, or on another device.
        """
        mask = environments
        if not isinstance(mask, wp.array):
            mask = wp.from_torch(mask) if hasattr(mask, "is_cuda") else wp.from_dlpack(mask)
        if (mask.dtype, mask.shape, mask.device) != (wp.bool, self.due.shape, self.device):
            raise SceneError(
                f"environments is {mask.dtype.__name__} of shape {mask.shape} on {mask.device}; "
                f"give a mask, bool of shape {self.due.shape}, on {self.device}, or an array of "
                "NumPy"
            )
        return mask

    def marks(self, mask: Any) -> Any:
        """Marks of the environments that a mask names, of NumPy or of Warp; None for all."""
        if mask is None:
            return self.due
        if isinstance(mask, np.ndarray):
            self.some.assign(mask.astype(np.int32))
        else:
            self.launch(warp_cut.mark, self.counts[0], mask, self.some)
        return self.some

    def solve(self, bodies: Any, sensors: Any, forces: Any, environments: Any = None) -> None:
        """Fill :attr:`capacitance`, :attr:`delta` [F] and what else there is; waits for nothing.

        Args:
            bodies: Poses, see :func:`as_array`, shape (e, b, 7).
            sensors: The same of the sensors, shape (e, s, 7); None for the frames of the worlds.
            forces: Normal forces that press bodies onto the cover [N], NaN for none, shape (e, b);
                None for those that they have themselves.
            environments: Mask of the environments that are solved, of NumPy or of Warp, None for
                all; what the others have is left as it is.

        Raises:
            SceneError: They are of another shape or precision, or on another device.
        """
        self._captured |= bool(self.device.is_capturing)
        bodies = as_array("poses", bodies, self.poses)
        sensors = self.worlds if sensors is None else as_array("sensors", sensors, self.frames)
        forces = self.own_forces if forces is None else as_array("forces", forces, self.forces)
        due = self.circuit.due = self.marks(environments)
        n, views = self.cut.number.shape
        size = self.whole.shape[0]
        green, cut, circuit = self.green, self.cut, self.circuit
        at = (self.shapes, self.places)
        rows, matrix, whole = self.rows, self.matrix, self.whole
        width, stood = rows.shape[1], (self.counts[1], views)
        self.launch(warp_cut.stand, stood, *at, green, due, bodies, sensors, cut)
        self._press(forces, due)
        self._look_near()
        self.launch(warp_cut.choose, stood, *at, green, cut)
        self.launch(warp_cut.place, (3 * n, views), *at, green, cut)
        self.launch(warp_cut.weigh, views, *at, green, cut)
        self.launch(pairs.rows, (n, width // warp_cut.WIDTH, views), green, cut, rows)
        turned = matrix.transpose((1, 0, 2))
        self.launch(solution.energies, (n, n, views), *at, cut, matrix)
        for values in (matrix, turned):
            self.launch(solution.from_functions, (n, views), cut, 1, values)
        self.launch(pairs.pairs, (n, n, views), green, cut, matrix)
        self.launch(pairs.bound_walls, (n, views), green, cut, rows, matrix)
        self.launch(pairs.bound_images, (n, views), green, cut, rows, matrix)
        self.launch(solution.to_functions, (width, views), cut, 1, rows)
        for values in (matrix, turned):
            self.launch(solution.to_functions, (n, views), cut, 0, values)
        self.launch(
            solution.assemble, (n, n, views), *at, cut, green.first, rows, matrix, self.loss
        )
        rest, loss, quadrature = self.left, self.loss, self.quadrature
        self.launch(solution.factorise, views, cut, matrix, rest.dropped)
        self.launch(solution.factorise_lossy, views, cut, matrix, loss, rest.dropped)
        solved = matrix, loss, self.solved, quadrature
        self.launch(solution.forward, (size, views), cut, green.terminals, rows, *solved)
        self._look_below()
        dim = size, size, views
        self.launch(network.change, dim, self.gap, self.near, *solved[2:], rest, whole)
        if self.fabric is not None:
            size = len(self.fabric.pair), views
            self.launch(warp_fabric.fabric_change, size, self.gap, self.fabric, self.pressed, whole)
        self.launch(network.eliminate, views, circuit, self.near, rest, whole)
        self.launch(
            network.report, (circuit.electrodes, views), circuit, whole,
            self.capacitance, self.delta, self.conductance, self.shields, rest.doubt, self.error,
        )  # fmt: skip

    def _press(self, forces: Any, due: Any) -> None:
        """Press bodies into the cover, if there is one, by forces [N], shape (e, b)."""
        if self.touch is None:
            return
        launch, out, touch = self.launch, self.contacts, self.touch
        cover, near, shape = self.foundation, self.near, self.contacts.active.shape
        launch(warp_touch.find_contacts, shape, self.outlines, cover, self.cut, near, forces, out)
        launch(warp_touch.undersides, (COARSE, *shape), self.outlines, cover, near, COARSE, out)
        launch(warp_touch.refine_grid, shape, cover, out)
        launch(warp_touch.undersides, (FINE, *shape), self.outlines, cover, near, FINE, out)
        launch(warp_touch.carry, shape, cover, near, out)
        found = touch.force, touch.compression, touch.total
        size = touch.force.shape[2], shape[1]
        launch(warp_touch.electrode_forces, size, cover, near, out, due, *found)
        if self.fabric is not None:
            outlines, gap, fabric, out = self.outlines, self.gap, self.fabric, self.pressed
            seen = self.cut.node, self.cut.clusters
            launch(warp_fabric.find_touching, shape, outlines, gap, near, *seen, out)
            size = out.depth.shape
            launch(warp_fabric.press_cells, size, outlines, gap, fabric, near, out)
            launch(warp_fabric.list_pressed, shape[1], out)
            launch(warp_fabric.spread, size, fabric, out)

    def _look_near(self) -> None:
        """What is near the design, and what the gap law adds for it."""
        near = self.outlines, self.gap
        (chunks, _, views), launch = self.near.depth.shape, self.launch
        size = len(self.places.group), views
        launch(warp_near.find_outside, size, self.shapes, self.places, self.green, self.cut)
        launch(warp_near.connect, views, self.places, self.cut, self.green.terminals)
        if chunks:
            launch(warp_near.find_near, views, *near, self.cut, self.near)
            launch(warp_near.press, (views, chunks), *near, self.near)
            launch(warp_near.press_out, views, self.gap, self.near)
            launch(warp_gap.local_change, (views, chunks), *near, self.green, self.near)

    def _look_below(self) -> None:
        """Charges, and the potentials that they leave in functions that are not solved for."""
        cut, green, rest, rows = self.cut, self.green, self.left, self.rows
        (n, columns, views), phi_columns, t = (
            rest.charge.shape,
            green.phi_columns,
            self.whole.shape[0],
        )
        launch, matrix, loss = self.launch, self.matrix, self.loss
        parts, batches = columns // pairs.COLUMNS, green.columns.shape[1]
        solved = matrix, loss, self.solved, self.quadrature
        launch(solution.charges, (t, views), cut, phi_columns, *solved, rest.charge)
        launch(charges.coarse, (t, views), cut, matrix, loss, rest.charge, rest.doubt)
        size = rest.sums.shape[0], parts, views
        launch(charges.modes, size, cut, phi_columns, rows, rest.charge, 0, rest.sums)
        size = batches, columns, views
        launch(charges.strengths, size, green, cut, rest.sums, rest.strength)
        launch(charges.to_clusters, (columns, views), cut, phi_columns, rest.charge, rest.on)
        at = self.shapes, self.places
        launch(charges.residuals, (n, parts, views), *at, green, cut, rest)

    def differentiate(self) -> Any:
        """Derivatives of the last matrices [F/m], [F/rad], shape (e, s, b, n, n, 6)."""
        environments, places, sensors = self.counts
        n, views = self.cut.number.shape
        circuit, green, cut, rest = self.circuit, self.green, self.cut, self.left
        m, t, phi_columns, room = (
            circuit.electrodes,
            self.whole.shape[0],
            green.phi_columns,
            self.room,
        )
        sources, modes = len(green.sources), rest.sums.shape[0]
        gap, near, chunks = self.gap, self.near, len(self.gap.owner)
        if self._slopes is None:
            self._slopes = [
                *(room(rows, phi_columns, views) for rows in (3 * n, n, sources, modes)),
                room(views, places, m, m, dtype=wp.spatial_vector),
                self._struct(warp_slope.Slopes, {
                    "volts": (t, m, views), "charge pull": (3 * n, phi_columns, views),
                    "lift": (places, views),
                    "part sink": (chunks, self.gap.columns.shape[1] + 1, places, views),
                }),
            ]  # fmt: skip
            self._slopes[-1].charge = self._slopes[0]
        charge, back, strength, sums, out, slopes = self._slopes
        launch, parts, at = self.launch, phi_columns // pairs.COLUMNS, (self.shapes, self.places)
        launch(charges.estimated, (n, phi_columns, views), cut, rest, charge)
        launch(charges.felt, (sources, parts, views), green, cut, charge, strength)
        launch(charges.answered, (modes, parts, views), green, cut, strength, sums)
        launch(charges.energies_below, (n, parts, views), *at, cut, charge, back)
        launch(solution.from_functions, (phi_columns, views), cut, 0, back)
        launch(charges.pairs_below, (n, parts, views), green, cut, charge, back)
        launch(solution.to_functions, (phi_columns, views), cut, 0, back)
        launch(charges.modes_below, (n, parts, views), cut, self.rows, sums, back)
        solved = self.matrix, self.loss, back, self.quadrature
        launch(solution.forward, (t, views), cut, t, back, *solved)
        launch(charges.add, (n, t, views), self.solved, back)
        launch(solution.charges, (t, views), cut, phi_columns, *solved, rest.charge)
        launch(
            charges.modes, (modes, parts, views), cut, phi_columns, self.rows, rest.charge, 1, sums
        )
        launch(charges.to_clusters, (phi_columns, views), cut, phi_columns, rest.charge, charge)
        size = green.columns.shape[1], phi_columns, views
        launch(charges.strengths, size, green, cut, sums, strength)
        launch(pairs.forces, (3 * n, parts, views), green, cut, charge, strength, slopes.pull)
        launch(network.follow, (m, views), circuit, cut, self.whole, slopes.volts)
        if chunks:
            both = self.outlines, gap
            launch(warp_slope.local_slopes, (views, chunks), *both, green, near, slopes)
            launch(warp_slope.press_slopes, views, *both, near, slopes)
        launch(network.slopes, (places, m, views), circuit, gap, near, cut, slopes, out)
        if self.fabric is not None:
            self._add_fabric_slopes(slopes.volts, out)
        return wp.array(
            ptr=out.ptr, dtype=wp.types.matrix(shape=(m, 6), dtype=wp.float32),
            shape=(environments, sensors, places, m), device=self.device,
        )  # fmt: skip

    def _add_fabric_slopes(self, volts: Any, out: Any) -> None:
        """Add what a fabric on the cover adds to derivatives of the electrodes' matrices."""
        launch, fabric, state, near = self.launch, self.fabric, self.pressed, self.near
        if self._fabric_slopes is None:
            shape, size = state.touches.shape, state.depth.shape
            self._fabric_slopes = self._struct(warp_fabric.FabricSlopes, {
                "rise": shape, "owner way source": size, "part": (len(fabric.pair), *shape),
            })  # fmt: skip
        found, gap, (places, views) = self._fabric_slopes, self.gap, state.touches.shape
        both = state, found
        launch(warp_fabric.find_rise, (places, views), near, found)
        launch(warp_fabric.cell_slopes, state.depth.shape, self.outlines, gap, fabric, near, *both)
        launch(warp_fabric.find_sources, state.depth.shape, fabric, *both)
        launch(warp_fabric.pair_slopes, found.part.shape, gap, fabric, *both)
        size = places, self.circuit.electrodes, views
        launch(
            warp_fabric.add_slopes, size, self.circuit, fabric, self.cut.moved, found, volts, out
        )

    def chips(
        self, readouts: Sequence[Readout], empty: Array, how: Mapping[str, Any]
    ) -> WarpChips | ChipsOfSensors:
        """Chips for all sensors, of one readout or of one each, see :class:`WarpChips`."""
        e, _, s = self.counts
        if len(readouts) == 1:
            return WarpChips(readouts[0], e, s, empty, self.device, **how)
        whole = registers(self.device, e, s, len(readouts[0].bank))

        def make(number: int, readout: Readout, **own: Any) -> WarpChips:
            part = Held(*(column[:, number : number + 1] for column in vars(whole).values()))
            return WarpChips(readout, e, 1, empty, self.device, held=part, **own)

        return ChipsOfSensors(readouts, make, registers=whole, **how)

    def launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:
        """Launch a kernel on the device."""
        wp.launch(kernel, dim=dim, inputs=list(arguments), device=self.device)


def known_device(name: str) -> Any:
    """Warp's device of a fleet's name for it.

    Raises:
        ValueError: There is none.
    """
    wp.config.quiet = True
    wp.init()
    try:
        return wp.get_device(name.removeprefix("warp:"))
    except Exception as error:
        known = ", ".join(["cpu", "warp:cpu", *map(str, wp.get_cuda_devices())])
        raise ValueError(f"device is {name!r}; there are {known}") from error


def as_array(what: str, values: Any, room: Any) -> Any:
    """Numbers, or poses of shape (..., 7), as an array of the device; a copy only of the host's.

    Those on the host are copied into ``room``, an array of the type, shape and device that are
    wanted: of transforms for poses.

    Raises:
        SceneError: They are of another shape or precision, on another device, or not contiguous.
    """
    if not on_device(values):
        room.assign(np.ascontiguousarray(values, np.float32))
        return room
    if not isinstance(values, wp.array):
        values = wp.from_dlpack(values)
    shape = room.shape if room.dtype is wp.float32 else (*room.shape, 7)
    if (values.dtype, values.shape, values.device) == (room.dtype, room.shape, room.device):
        return values
    if (values.shape, values.dtype, values.device) != (shape, wp.float32, room.device) or (
        not values.is_contiguous
    ):
        raise SceneError(
            f"{what} are {values.dtype.__name__} of shape {values.shape} on {values.device}; give "
            f"contiguous float32 of shape {shape} on {room.device}"
        )
    out = wp.array(ptr=values.ptr, dtype=room.dtype, shape=room.shape, device=room.device)
    out.owner = values  # whose memory it is
    return out
