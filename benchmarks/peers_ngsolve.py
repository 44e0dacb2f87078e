"""NGSolve in ``peers.py``: on the fixed mesh, and with a new conforming mesh at every step."""

from __future__ import annotations

from typing import Any

import numpy as np
from peers_iterative import TOLERANCE
from peers_task import Array, bar_corners, design, within

from capsense.constants import EPS0
from capsense.masked import MeshSensor
from capsense.mesh import TetMesh

_MM = 1e3
"""Netgen meshes in millimetres."""


class NgSolve:
    """H1 of order 1 on the fixed mesh; the bar's nodes leave the free degrees of freedom."""

    name = "NGSolve"
    settings = (
        f"order 1, CGSolver with the Jacobi smoother, warm start, tolerance {TOLERANCE:g} of the "
        "load, energy form"
    )

    def __init__(self, mesh: TetMesh) -> None:
        import ngsolve as ng
        from netgen.meshing import FaceDescriptor, Mesh

        copied = Mesh(dim=3)
        copied.AddPoints(np.ascontiguousarray(mesh.points))
        copied.Add(FaceDescriptor(bc=1, domin=1, surfnr=1))
        copied.AddElements(
            dim=3, index=1, data=np.ascontiguousarray(mesh.tets.astype(np.int32)), base=0
        )
        space = ng.H1(ng.Mesh(copied), order=1)
        trial, test = space.TnT()
        self._form = ng.BilinearForm(EPS0 * ng.grad(trial) * ng.grad(test) * ng.dx).Assemble()
        self._ng, self._matrix = ng, self._form.mat
        x, y, z = (np.ascontiguousarray(c) for c in mesh.points.T)
        self._points = (x, y, z)
        values, self._free = MeshSensor(mesh, design().electrode_names).unit_potentials()
        self._bits = ng.BitArray(self._free.tolist())
        self._zero, self._image = (self._matrix.CreateColVector() for _ in range(2))
        self._zero[:] = 0.0
        scaled = self._matrix.CreateSmoother(self._bits)
        self._solutions, self._goals = [], []
        for column in values.T:
            vector = self._matrix.CreateColVector()
            vector.FV().NumPy()[:] = column
            self._image.data = self._matrix * vector
            norm = self._ng.InnerProduct(self._image, (scaled * self._image).Evaluate())
            self._goals.append(TOLERANCE * norm**0.5)
            self._solutions.append(vector)
        self.n_tets, self.unknowns = mesh.n_tets, int(self._free.sum())

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        from ngsolve.krylovspace import CGSolver

        held = np.flatnonzero(within(self._points, *bar_corners(x, gap)) & self._free)
        bits = self._ng.BitArray(self._bits)
        for node in held.tolist():
            bits.Clear(node)
        smoother = self._matrix.CreateSmoother(bits)
        images = []
        for vector, goal in zip(self._solutions, self._goals, strict=True):
            vector.FV().NumPy()[held] = 0.0
            solver = CGSolver(self._matrix, smoother, atol=goal, maxiter=2000)
            solver.Solve(rhs=self._zero, sol=vector, initialize=False)
            self._image.data = self._matrix * vector
            images.append(self._image.FV().NumPy().copy())
        potentials = np.stack([v.FV().NumPy() for v in self._solutions])
        energy = potentials @ np.stack(images).T
        return 0.5 * (energy + energy.T)


class NgSolveRemeshed:
    """A new mesh that conforms to bar and electrodes at every step, hp-refined to their edges.

    The mesh goes through the bar, and is solved with and without it: only in the difference on one
    mesh do the errors of C⁰, large against ΔC, cancel. :meth:`step` therefore returns ΔC.
    The settings are the fastest among sixteen (maxh 40 to 100 mm, grading 0.3 to 0.6, one to three
    levels, orders 2 and 3) that keep ΔC within 3 %.
    """

    name = "NGSolve, remeshed"
    returns_change = True
    settings = (
        "Netgen with maxh 100 mm, grading 0.4; RefineHP of two levels, factor 0.15, at the "
        "electrodes' edges; order 3, condensed; sparsecholesky, with and without the bar"
    )

    def __init__(self) -> None:
        import netgen.occ as occ
        import ngsolve as ng

        ng.SetNumThreads(1)
        self._ng, self._occ = ng, occ
        self.n_tets = self.unknowns = 0

    def step(self, x: float, gap: float) -> Array:
        """ΔC [F] with the bar at x [m], gap [m]."""
        ng = self._ng
        netgen_mesh = self._geometry(x, gap).GenerateMesh(
            maxh=100, grading=0.4, parallel_meshing=False
        )
        mesh = ng.Mesh(netgen_mesh)
        mesh.RefineHP(2, factor=0.15)
        space = ng.H1(mesh, order=3)
        trial, test = space.TnT()
        form = ng.BilinearForm(ng.grad(trial) * ng.grad(test) * ng.dx, condense=True).Assemble()
        self.n_tets, self.unknowns = mesh.ne, space.ndof
        names = design().electrode_names
        fixed = space.GetDofs(mesh.Boundaries("wall|" + "|".join(names)))
        bar = space.GetDofs(mesh.Materials("bar")) | space.GetDofs(mesh.Boundaries("bar"))
        without = self._energies(form, space, mesh, fixed)
        return (self._energies(form, space, mesh, fixed | bar) - without) * EPS0 / _MM

    def _energies(self, form: Any, space: Any, mesh: Any, fixed: Any) -> Array:
        ng, names = self._ng, design().electrode_names
        inverse = form.mat.Inverse(~fixed & space.FreeDofs(True), inverse="sparsecholesky")
        potentials = []
        for name in names:
            unit = ng.GridFunction(space)
            unit.Set(
                mesh.BoundaryCF({name: 1.0}, default=0.0),
                definedon=mesh.Boundaries("|".join(names)),
            )
            unit.vec.data -= inverse * (form.mat * unit.vec).Evaluate()
            potentials.append(unit.vec)
        images = [(form.mat * p).Evaluate() for p in potentials]
        return np.array([[ng.InnerProduct(p, q) for q in images] for p in potentials])

    def _geometry(self, x: float, gap: float) -> Any:
        occ = self._occ
        lower, upper = design().domain.lower * _MM, design().domain.upper * _MM
        box = occ.Box(occ.Pnt(*lower), occ.Pnt(*upper))
        box.faces.name = "wall"
        low, high = (corner * _MM for corner in bar_corners(x, gap))
        bar = occ.Box(occ.Pnt(*low), occ.Pnt(*high))
        bar.faces.name = bar.solids.name = "bar"
        parts = [box - bar, bar]
        for electrode in design().electrodes:
            a, b = (corner * _MM for corner in electrode.surface.bounds)
            plane = occ.WorkPlane(occ.Axes((a[0], a[1], a[2]), occ.Z, occ.X))
            face = plane.Rectangle(b[0] - a[0], b[1] - a[1]).Face()
            face.faces.name = electrode.name
            face.edges.hpref = 1
            parts.append(face)
        return occ.OCCGeometry(occ.Glue(parts))
