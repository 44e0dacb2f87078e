"""Capacitances of a disc electrode below a soft cover that a body presses in, by finite elements.

``touch_fem.py --write`` runs it; needs NGSolve (``pip install "capsense[peers]"``). The scene has
an axis of rotation: the disc at z = 0 with, where the case has them, a grounded guard ring in its
plane and a board over a ground plane below it; the cover; a body on the axis; a grounded cylinder
in place of the box. The cover's outer face is at height min(t, underside of the body), with air
above it (elastic foundation: it gives way at each point on its own). Below a grounded fabric, what
lies above the cover's outer face is no part of the domain.

Curved triangles are refined where the fields of orders 3 and 4 differ, for one volt on the
electrode and on the body in turn, until their energies agree. The value is that of order 4, its
stated error the difference to order 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0

Array = NDArray[np.float64]
ORDERS = (3, 4)
"""Of the elements: the value is that of the second."""
HELD = "electrode|body|ground"
"""Boundaries of given potential."""
TOLERANCE = 5e-6
"""Difference of the energies of both orders, relative, at which a mesh is fine enough."""
TRIANGLES = 20_000
"""At which a mesh is no longer refined."""
MARKED = 0.1
"""Share of the largest difference above which a triangle is refined."""
HALVINGS = 12
"""How often lines are halved towards rims."""
WEDGE = 7
"""How often outlines are halved towards the place of contact."""
TINY = 1e-12
"""Lengths and angles below it are 0 [m, rad]."""
LARGEST = 0.25
"""Largest triangle of the first mesh, over the radius of the domain."""
GRADINGS = (0.3, 0.25, 0.35, 0.2, 0.4, 0.15)
"""Growth of triangles; where the mesher fails in the wedge beside a place of contact, the next."""


class Values(NamedTuple):
    """Capacitances of electrode and body [F], and by how much order 4 differs [F]."""

    own: float
    """Charge of the electrode at 1 V, the body at 0."""
    mutual: float
    """Charge of the body, with the sign of a Maxwell matrix; 0 without a body."""
    body: float
    """Charge of the body at 1 V, the electrode at 0; 0 without a body."""
    error: float
    """Error of ``own``."""
    floating_error: float
    """Error of ``floating``."""

    @property
    def floating(self) -> float:
        """Self-capacitance beside an uncharged body [F]."""
        return self.own - (self.mutual**2 / self.body if self.body else 0.0)


@dataclass(frozen=True)
class Piece:
    """A straight piece of a body's outline, or an arc of up to half a turn [m, rad].

    The outline runs from the lowest point of the body on the axis to the highest.
    """

    start: tuple[float, float]
    """Radius and height where it starts; of an arc, of its centre."""
    ends: tuple[float, float]
    """From and to: angle from straight down, counterclockwise; of a straight piece 0 and 1."""
    along: tuple[float, float] = (0.0, 0.0)
    """From start to end of a straight piece."""
    radius: float = 0.0
    """Of an arc; 0 of a straight piece."""

    def at(self, s: float) -> tuple[float, float]:
        """Point at a parameter."""
        (r, z), (dr, dz) = self.start, self.along
        if self.radius:
            r, z = r + self.radius * math.sin(s), z - self.radius * math.cos(s)
            return (0.0 if abs(r) < TINY else r), z
        return r + s * dr, z + s * dz

    def reaches(self, height: float) -> float:
        """Parameter where it rises through a height; its first end where it is all above."""
        a, b = self.ends
        if self.at(a)[1] >= height - TINY and self.at(b)[1] > height + TINY:
            return a
        if self.at(b)[1] <= height + TINY:
            return b
        if self.radius:
            return math.acos((self.start[1] - height) / self.radius)
        return (height - self.start[1]) / self.along[1]


def ball(radius: float, lowest: float) -> list[Piece]:
    """Outline of a ball whose lowest point is at a height [m]."""
    return [Piece((0.0, lowest + radius), (0.0, math.pi), radius=radius)]


def punch(radius: float, length: float, edge: float, lowest: float) -> list[Piece]:
    """Outline of an upright cylinder with rounded edges [m]."""
    flat, quarter = radius - edge, math.pi / 2
    return [
        Piece((0.0, lowest), (0.0, 1.0), (flat, 0.0)),
        Piece((flat, lowest + edge), (0.0, quarter), radius=edge),
        Piece((radius, lowest + edge), (0.0, 1.0), (0.0, length - 2 * edge)),
        Piece((flat, lowest + length - edge), (quarter, math.pi), radius=edge),
        Piece((flat, lowest + length), (0.0, 1.0), (-flat, 0.0)),
    ]


@dataclass(frozen=True)
class Section:
    """The half-plane r >= 0 of a scene [m]."""

    radius: float
    """Of the electrode."""
    thickness: float
    """Of the cover; 0 is none."""
    eps_r: float = 1.0
    outline: list[Piece] = field(default_factory=list)
    """Of the body; none is no body."""
    fabric: bool = False
    """Whether the cover's outer face is grounded."""
    guard: tuple[float, float] | None = None
    """Inner and outer radius of a grounded ring at z = 0."""
    board: tuple[float, float] | None = None
    """Thickness and relative permittivity of a board over a ground plane of its size."""
    extent: float = 0.045
    """Radius of cover and board."""
    domain: tuple[float, float, float] = (0.113, -0.020, 0.180)
    """Radius, floor and ceiling of the grounded cylinder."""


def graded(low: float, high: float, fine_at: float, halvings: int = HALVINGS) -> list[float]:
    """Ends of parts of an interval that halve towards one of its ends."""
    steps = [0.0] + [0.5**k for k in range(halvings, -1, -1)]
    far = high if fine_at == low else low
    parts = [fine_at + (far - fine_at) * u for u in steps]
    return parts if fine_at == low else parts[::-1]


class Drawing:
    """Lines and arcs of a section for Netgen, in millimetres."""

    REGIONS = ("below", "board", "cover", "air")

    def __init__(self) -> None:
        from netgen.geom2d import SplineGeometry

        self.geometry: Any = SplineGeometry()
        self._points: dict[tuple[int, int], int] = {}

    def point(self, r: float, z: float) -> int:
        """Number of a point [m]."""
        key = (round(1e10 * r), round(1e10 * z))
        if key not in self._points:
            self._points[key] = self.geometry.AppendPoint(1e3 * r, 1e3 * z)
        return self._points[key]

    def line(
        self, start: tuple[float, float], end: tuple[float, float], left: str, right: str, name: str
    ) -> None:
        """A straight line; regions on its left and right, "" where the domain ends."""
        a, b = self.point(*start), self.point(*end)
        if a != b:
            self._append(["line", a, b], left, right, name)

    def piece(
        self, piece: Piece, ends: tuple[float, float], right: str, fine: float
    ) -> list[float]:
        """Part of a body's outline, ``right`` beside it; radii of its points."""
        if ends[1] - ends[0] < TINY:
            return []
        parts = graded(*ends, fine, WEDGE)
        for s, e in pairwise(parts):
            if not piece.radius:
                self.line(piece.at(s), piece.at(e), "", right, "body")
                continue
            middle, reach = (s + e) / 2, piece.radius / math.cos((e - s) / 2)
            corner = Piece(piece.start, (0.0, math.pi), radius=reach).at(middle)
            joint = self.geometry.AppendPoint(1e3 * corner[0], 1e3 * corner[1])
            a, b = self.point(*piece.at(s)), self.point(*piece.at(e))
            self._append(["spline3", a, joint, b], "", right, "body")
        return [piece.at(s)[0] for s in parts]

    def _append(self, shape: list[Any], left: str, right: str, name: str) -> None:
        number = {"": 0} | {n: k + 1 for k, n in enumerate(self.REGIONS)}
        self.geometry.Append(shape, leftdomain=number[left], rightdomain=number[right], bc=name)

    def mesh(self, largest: float) -> Any:
        """The first mesh, curved; of triangles up to a size [m]."""
        import ngsolve as ng
        from netgen.meshing import NgException

        for k, name in enumerate(self.REGIONS):
            self.geometry.SetMaterial(k + 1, name)
        for grading in GRADINGS:
            try:
                mesh = ng.Mesh(self.geometry.GenerateMesh(maxh=1e3 * largest, grading=grading))
            except NgException:
                if grading == GRADINGS[-1]:
                    raise
                continue
            mesh.Curve(ORDERS[1])
            return mesh


def draw(s: Section) -> Drawing:
    """The section's lines."""
    d = Drawing()
    (wall, floor, ceiling), t, ext = s.domain, s.thickness, s.extent
    top = "cover" if t else "air"
    under = "board" if s.board else "below"
    deep = -s.board[0] if s.board else 0.0
    d.line((0, 0), (0, deep), under, "", "axis")
    d.line((0, deep), (0, floor), "below", "", "axis")
    d.line((0, floor), (wall, floor), "below", "", "ground")
    d.line((wall, floor), (wall, 0), "below", "", "ground")
    if s.board:
        d.line((0, deep), (ext, deep), "board", "below", "ground")
        d.line((ext, deep), (ext, 0), "board", "below", "inner")
    radii = sorted({0.0, s.radius, *(s.guard or ()), ext, wall})
    for a, b in pairwise(radii):
        middle = (a + b) / 2
        name = "electrode" if middle < s.radius else "inner"
        if s.guard and s.guard[0] < middle < s.guard[1]:
            name = "ground"
        inside = middle < ext
        above, beneath = (top, under) if inside else ("air", "below")
        cut = graded(a, b, b if name == "electrode" else a)
        for p, q in pairwise(cut):
            d.line((p, 0), (q, 0), above, beneath, name)
    beside = body(d, s, top)
    if t:
        outer = "" if s.fabric else "air"
        for p, q in pairwise([*beside, ext]):
            d.line((p, t), (q, t), outer, "cover", "ground" if s.fabric else "inner")
        d.line((ext, 0), (ext, t), "cover", "air", "inner")
    if s.fabric:
        d.line((ext, t), (wall, t), "", "air", "ground")
        d.line((wall, 0), (wall, t), "air", "", "ground")
    else:
        d.line((wall, 0), (wall, ceiling), "air", "", "ground")
        d.line((wall, ceiling), (0, ceiling), "air", "", "ground")
    return d


def body(d: Drawing, s: Section, top: str) -> list[float]:
    """Draw the axis above the electrode and the body.

    Returns:
        Radii [m] of points of the cover's outer face, from where it parts from the body. They are
        those of the body's own points: the wedge between both is cut into slices.
    """
    t, ceiling = s.thickness, s.domain[2]
    if not s.outline:
        d.line((0, t), (0, 0), top, "", "axis")
        if not s.fabric:
            d.line((0, ceiling), (0, t), "air", "", "axis")
        return [0.0]
    lowest = s.outline[0].at(s.outline[0].ends[0])[1]
    d.line((0, min(t, lowest)), (0, 0), top, "", "axis")
    if lowest > t + TINY:
        d.line((0, lowest), (0, t), "air", "", "axis")
    contact, radii = 0.0, []
    for piece in s.outline:
        a, b = piece.ends
        part = piece.reaches(t)
        if part > a:
            contact = piece.at(part)[0]
            d.piece(piece, (a, part), "cover", part)
        if not s.fabric:
            radii += d.piece(piece, (part, b), "air", part)
    if not s.fabric:
        d.line((0, ceiling), s.outline[-1].at(s.outline[-1].ends[1]), "air", "", "axis")
    furthest = radii.index(max(radii)) + 1 if radii else 0
    return [contact, *(r for r in radii[:furthest] if r > contact + TINY)]


def solved(mesh: Any, order: int, eps: Any, names: list[str]) -> tuple[Array, list[Any]]:
    """Maxwell matrix [F] of the named boundaries, all others at 0, and the potentials."""
    import ngsolve as ng

    space = ng.H1(mesh, order=order, dirichlet=HELD)
    u, v = space.TnT()
    weight = 2 * math.pi * ng.x * eps
    form = ng.BilinearForm(weight * ng.grad(u) * ng.grad(v) * ng.dx).Assemble()
    inverse = form.mat.Inverse(space.FreeDofs(), "sparsecholesky")
    potentials = []
    for name in names:
        g = ng.GridFunction(space)
        g.Set(mesh.BoundaryCF({name: 1.0}, default=0.0), definedon=mesh.Boundaries(HELD))
        rest = (-form.mat * g.vec).Evaluate()
        g.vec.data += inverse * rest
        potentials.append(g)
    images = [(form.mat * g.vec).Evaluate() for g in potentials]
    energy = [[ng.InnerProduct(g.vec, i) for i in images] for g in potentials]
    return EPS0 * 1e-3 * np.array(energy), potentials


def converged(s: Section, tolerance: float) -> Iterator[tuple[Array, Array]]:
    """Maxwell matrices [F] of both orders on meshes that become finer, until they agree."""
    import ngsolve as ng

    mesh = draw(s).mesh(LARGEST * s.domain[0])
    names = ["electrode"] + ["body"] * bool(s.outline and not s.fabric)
    table = {"below": 1.0, "air": 1.0, "cover": s.eps_r, "board": s.board[1] if s.board else 1.0}
    while True:
        eps = mesh.MaterialCF(table)
        (low, coarse), (high, fine) = (solved(mesh, order, eps, names) for order in ORDERS)
        yield low, high
        errors = np.zeros(mesh.ne)
        for k, (u, v) in enumerate(zip(coarse, fine, strict=True)):
            difference = ng.grad(v) - ng.grad(u)
            density = EPS0 * 1e-3 * 2 * math.pi * ng.x * eps * difference * difference
            errors += ng.Integrate(density, mesh, ng.VOL, element_wise=True).NumPy() / high[k, k]
        if errors.sum() < tolerance or mesh.ne > TRIANGLES:
            return
        marked = errors > MARKED * errors.max()
        for element, mark in zip(mesh.Elements(ng.VOL), marked.tolist(), strict=True):
            mesh.SetRefinementFlag(element, bool(mark))
        mesh.Refine()
        mesh.Curve(ORDERS[1])


def solve(s: Section, tolerance: float = TOLERANCE) -> Values:
    """Capacitances of a section [F].

    Args:
        s: The section.
        tolerance: As ``TOLERANCE``.
    """
    *_, pair = converged(s, tolerance)
    values = []
    for found in pair:
        matrix = np.zeros((2, 2))
        matrix[: len(found), : len(found)] = found
        values.append(Values(matrix[0, 0], matrix[0, 1], matrix[1, 1], 0.0, 0.0))
    low, high = values
    return high._replace(
        error=abs(high.own - low.own), floating_error=abs(high.floating - low.floating)
    )
