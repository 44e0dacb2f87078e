"""What bodies are made of, and what ties them to ground."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from capsense.constants import UNIT
from capsense.scene import Body, Capsule, Layers, Scene, Sphere, SurfaceMesh, TriMesh
from capsense.scene.geometry_kernels import parted
from capsense.scene.materials import Grounding, Material, ties_of
from capsense.scene.scene import PackedScene
from capsense.scene.shapes import ShapeKind
from capsense.solver.tree.dynamic_surface import DipoleLayer, DynamicBody
from capsense.solver.tree.rigid import HALF_SPACE, RigidShape

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int64]

CONDUCTING = 1e4
"""Magnitude of the complex permittivity from which the inside of a body holds no field."""
_BOUND = 300.0, 3000.0
"""Real permittivities between which displacement current comes to tie a body to ground."""
_CONTACT = 6.0
"""Size of a body over that of the contact that ties it to ground."""
FLOATING_PENALTY = 1e8
"""Energy [1/m] of the net charge of conductors that touch each other and float together."""
RIGID_TIE = 1e6
"""Capacitance [m] over 4π eps0 that ties a conductor to the local ground as a wire does: bodies
have some tenths of their size, and rounding errors stay below a millionth."""
_UNSEEN = TriMesh | Layers | SurfaceMesh
"""Shapes that are not looked at when it is asked which conductors touch."""
_ALONG = np.linspace(0.0, 1.0, 33)
"""Where along the axis of a capsule its distance from a shape with edges is taken."""
_TOUCH = 1e-6
"""Conductors nearer than this, over the length unit, touch."""


@dataclass(frozen=True, eq=False)
class Matter:
    """Permittivities and ties of n bodies."""

    eps: Complex
    """Complex relative permittivity, infinite for conductors, shape (n,)."""
    ground: Array
    """Capacitance to ground of the whole conductor that a body belongs to [F] over ``unit``;
    infinite for grounded bodies, 0 for floating ones, shape (n,)."""
    group: Ints
    """First body of the conductor that a body belongs to, which are those of one name and those
    that touch, directly or not; else itself, shape (n,)."""
    unit: float = 1.0
    """Length unit of what follows from ``ground`` [m]."""
    local: Array | None = None
    """Capacitance to the local ground of the sensor [F] over ``unit``, shape (n,); None where no
    body is tied to it."""

    @cached_property
    def conducting(self) -> NDArray[np.bool_]:
        """Which bodies hold no field inside, shape (n,)."""
        return np.isinf(self.eps.real)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which bodies are conductors that are not at ground, shape (n,)."""
        return self.conducting & np.isfinite(self.ground)

    @cached_property
    def some_free(self) -> bool:
        """Whether there are such."""
        return bool(self.free.any())

    @cached_property
    def lossy(self) -> bool:
        """Whether a body is neither a conductor nor free of losses."""
        return bool(((self.eps.imag != 0) & ~self.conducting).any())

    @cached_property
    def inverse_susceptibility(self) -> Complex:
        """1 / (eps - 1), zero for conductors, shape (n,)."""
        out = np.zeros(len(self.eps), complex)
        soft = ~self.conducting
        less = self.eps[soft] - 1.0
        out[soft] = 1.0 / np.where(np.abs(less) < 1e-9, 1e-9, less)
        return out

    def ties(self, sizes: Array) -> Complex:
        """Energy of each body's net charge beyond that of its field [1/m]; infinite if it has none.

        A conductor has that of its capacitance to ground. Current comes to other matter through a
        contact of size ``l``, in series with it: 1 / (eps l). Displacement current counts only
        where eps is large, so that plastics stay without net charge.

        Args:
            sizes: Capacitances of the bodies in free space over 4π eps0 [m], shape (n,).
        """
        out = self._ground_ties
        if self.conducting.all():
            return out
        out, soft = out.copy(), ~self.conducting
        eps = self.eps[soft]
        x = np.clip(np.log(eps.real / _BOUND[0]) / np.log(_BOUND[1] / _BOUND[0]), 0.0, 1.0)
        current = 1j * eps.imag + eps.real * x * x * (3 - 2 * x)
        tied = (current != 0) & np.isfinite(out[soft].real)
        path = (_CONTACT - 1.0) / (np.where(tied, current, 1.0) * sizes[soft])
        out[soft] = np.where(tied, out[soft] + path, np.inf)
        return out

    @cached_property
    def _ground_ties(self) -> Complex:
        with np.errstate(divide="ignore"):
            return (UNIT / self.ground).astype(complex)

    def joined(self, scene: Scene, packed: PackedScene, chosen: NDArray[np.intp]) -> Matter:
        """Take conductors that touch each other for one, on the sum of their ties to ground.

        Meshes and depth images are not looked at, nor are bodies that are all at ground.
        """
        if not self.some_free:
            return self
        seen = self.conducting & (packed.kinds[chosen] < ShapeKind.MESH)
        near = _TOUCH * self.unit
        low, high = packed.bounds[chosen, 0] - 0.5 * near, packed.bounds[chosen, 1] + 0.5 * near
        close = ((low[:, None] <= high) & (high[:, None] >= low)).all(axis=2)
        close &= seen[:, None] & seen & (self.free[:, None] | self.free)
        close &= self.group[:, None] != self.group
        first, second = np.nonzero(np.triu(close, 1))
        apart = parted(
            chosen[np.stack([first, second], axis=1)],
            packed.kinds, packed.params, packed.rotation, packed.position, near,
        )  # fmt: skip
        first, second = first[~apart], second[~apart]
        ends, radius = _axes(packed, chosen)
        gaps = segment_distance(ends[first], ends[second]) - radius[first] - radius[second]
        group = self.group.copy()
        for a, b, gap in zip(first.tolist(), second.tolist(), gaps.tolist(), strict=True):
            if group[a] == group[b]:
                continue
            if math.isnan(gap):
                meet = touch(scene[int(chosen[a])], scene[int(chosen[b])], near)
            else:
                meet = gap <= near
            if meet:
                group[group == max(group[a], group[b])] = min(group[a], group[b])
        return _grouped(self, tuple(group.tolist()))

    def repeated(self, places: Sequence[int]) -> Matter:
        """Matter of parts of bodies; those of one conductor share its net charge.

        Args:
            places: Body of each part, ascending.
        """
        if len(places) == len(self.eps) == len(set(places)):
            return self
        return _repeated(self, tuple(places))

    def write(self, records: NDArray[np.void], shapes: Sequence[RigidShape | DynamicBody]) -> None:
        """Enter what the kernels need to know; losses are left to ``lossy.solve_lossy``."""
        ties, inverse_susceptibility = (
            self.ties(sizes_of(records, shapes)),
            self.inverse_susceptibility,
        )
        members = np.bincount(self.group, minlength=len(records))[self.group]
        none = np.isinf(ties.real)
        shared = none & (members > 1) & self.conducting
        records["neutral"], records["free"] = none & ~shared, self.free
        records["ground_elastance"] = np.where(
            shared, FLOATING_PENALTY, np.where(none, 0.0, ties.real)
        )
        records["group"], records["inverse_susceptibility"] = (
            self.group,
            inverse_susceptibility.real,
        )
        if self.local is not None:
            records["local_tie"] = np.where(
                self.conducting, np.minimum(self.local / UNIT, RIGID_TIE), 0.0
            )
        records["polarization_stiffness"] = HALF_SPACE * np.abs(inverse_susceptibility)
        for k in np.flatnonzero(inverse_susceptibility).tolist():
            shape = shapes[k]
            block = shape.neumann_to_dirichlet
            if block is not None:  # `.ctypes` takes much longer
                records["neumann_to_dirichlet"][k] = block.__array_interface__["data"][0]
                records["n_tabulated"][k] = len(block)
            if isinstance(shape, DynamicBody):
                records["sheet"][k] = shape.sheet
            if isinstance(shape, DipoleLayer):  # its one even function has no net charge
                records["neutral"][k], records["ground_elastance"][k] = 0, 0.0
                records["group"][k] = k
                records["polarization_stiffness"][k] = np.abs(inverse_susceptibility[k])


def matter_of(
    bodies: Sequence[Body], frequency: float, unit: float = 1.0, *, local: bool = False
) -> Matter:
    """Look up what bodies are made of, at a frequency [Hz], with lengths in a unit [m].

    ``local`` tells that the sensor has a local ground apart from earth.
    """
    known = tuple([(b.material, b.grounding, b.conductor) for b in bodies])
    return _matter(known, frequency, unit, local)


@lru_cache(maxsize=64)
def _matter(
    bodies: tuple[tuple[Material, Grounding, str | None], ...],
    frequency: float,
    unit: float,
    local: bool,
) -> Matter:
    eps = np.array([material.complex_permittivity(frequency) for material, _, _ in bodies], complex)
    eps[np.abs(eps) >= CONDUCTING] = np.inf
    ties = np.array([ties_of(grounding) for _, grounding, _ in bodies], float).reshape(-1, 2)
    group, members = np.arange(len(bodies)), Counter(name for _, _, name in bodies)
    first: dict[str, int] = {}
    for k, (_, _, name) in enumerate(bodies):
        if name is not None and np.isinf(eps[k].real):
            group[k] = first.setdefault(name, k)
        elif name is not None:  # no charge flows through it, so that it has a part of the tie
            ties[k] /= members[name]
    earth, own = ties.T / unit
    if local and own.any():
        return Matter(eps, earth, group, unit, own)
    return Matter(eps, earth + own, group, unit)


@lru_cache(maxsize=64)
def _grouped(matter: Matter, group: tuple[int, ...]) -> Matter:
    joint = np.array(group)
    each = np.flatnonzero(matter.group == np.arange(len(group)))  # a conductor's tie is known once

    def total(ties: Array) -> Array:
        out = np.zeros(len(group))
        np.add.at(out, joint[each], ties[each])
        return out[joint]

    local = None if matter.local is None else total(matter.local)
    return replace(matter, ground=total(matter.ground), group=joint, local=local)


@lru_cache(maxsize=64)
def _repeated(matter: Matter, places: tuple[int, ...]) -> Matter:
    at = np.array(places, dtype=np.int64)
    first: dict[int, int] = {}
    group = [first.setdefault(g, k) for k, g in enumerate(matter.group[at].tolist())]
    return replace(
        matter, eps=matter.eps[at], ground=matter.ground[at], group=np.array(group, np.int64),
        local=None if matter.local is None else matter.local[at],
    )  # fmt: skip


def sizes_of(records: NDArray[np.void], shapes: Sequence[RigidShape | DynamicBody]) -> Array:
    """Capacitances of bodies in free space over 4π eps0 [m], shape (n,)."""
    return records["scale"] * np.array([s.capacitance for s in shapes])


def touch(first: Body, second: Body, near: float = _TOUCH) -> bool:
    """Whether two solids meet, nearer than so much [m]; of two with edges, as far as the corners of
    one tell."""
    if isinstance(first.shape, _UNSEEN) or isinstance(second.shape, _UNSEEN):
        return False
    ends, others = _axis(first), _axis(second)
    if ends is not None and others is not None:
        apart = segment_distance(ends[0], others[0])
        return bool(apart <= ends[1] + others[1] + near)
    for axis, other in ((ends, second), (others, first)):
        if axis is not None:
            points = axis[0][0] + _ALONG[:, None] * (axis[0][1] - axis[0][0])
            off = other.shape.signed_distance(other.pose.inverse().apply(points))
            return bool(off.min() <= axis[1] + near)
    for one, other in ((first, second), (second, first)):
        points = other.pose.inverse().apply(one.pose.apply(_surface_points(one)))
        if (other.shape.signed_distance(points) <= near).any():
            return True
    return False


def _axis(body: Body) -> tuple[Array, float] | None:
    """Ends of the axis of a ball or capsule, (2, 3), and its radius [m]; None of other shapes."""
    if not isinstance(body.shape, Sphere | Capsule):
        return None
    half = 0.5 * body.shape.length if isinstance(body.shape, Capsule) else 0.0
    return body.pose.apply([[0.0, 0.0, -half], [0.0, 0.0, half]]), body.shape.radius


def _axes(packed: PackedScene, chosen: NDArray[np.intp]) -> tuple[Array, Array]:
    """Bounding boxes and radii of bodies of a scene, (n, 2, 3) and (n,); the radius of other shapes
    is nan."""
    kinds, (radius, half, _) = packed.kinds[chosen], packed.params[chosen].T
    capsule = kinds == ShapeKind.CAPSULE
    arm = np.where(capsule, half, 0.0)[:, None] * packed.rotation[chosen, :, 2]
    middle = packed.position[chosen]
    radius = np.where(capsule | (kinds == ShapeKind.SPHERE), radius, np.nan)
    return np.stack([middle - arm, middle + arm], axis=1), radius


def segment_distance(first: Array, second: Array) -> Array:
    """Distances of line segments [m], each given by its ends, (..., 2, 3), shape (...).

    After C. Ericson, *Real-Time Collision Detection* (2005), section 5.1.9.
    """
    u, v = first[..., 1, :] - first[..., 0, :], second[..., 1, :] - second[..., 0, :]
    w = first[..., 0, :] - second[..., 0, :]
    a, b, c, d, e = ((x * y).sum(axis=-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = a * c - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(det > 1e-12 * a * c, np.clip((b * e - c * d) / det, 0.0, 1.0), 0.0)
        t = np.where(c > 0, (b * s + e) / c, 0.0)
        over = (t < 0.0) | (t > 1.0) | (c == 0)
        t = np.clip(t, 0.0, 1.0)
        s = np.where(over, np.where(a > 0, np.clip((b * t - d) / a, 0.0, 1.0), 0.0), s)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)


def _surface_points(body: Body) -> Array:
    found = body.shape.__dict__.get("_surface_points")
    if found is None:
        from capsense.solver.bodies.panels import panels_of

        panels = panels_of(body.shape, 80)
        found = np.concatenate([panels.centers, panels.corners.reshape(-1, 3)])
        body.shape.__dict__["_surface_points"] = found
    return found
