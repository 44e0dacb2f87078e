"""Direct solvers of ``peers.py``: one symbolic analysis, a numeric factorisation at every step.

The bar's nodes are held by a large number on their diagonal, so that the pattern stays.
"""

from __future__ import annotations

import ctypes

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from peers_task import Array, System

HOLD = 1e6
"""Factor on the diagonal of a held node: its potential is then 1e-6 of its neighbours'."""


class Pardiso:
    """Intel MKL PARDISO, Cholesky in single precision: phase 22 and 33 at every step."""

    name = "MKL PARDISO"
    settings = (
        "pypardiso's handle, mtype 2, nested dissection, single precision (iparm 28), phases 22 "
        "and 33 only, six right-hand sides at once"
    )

    def __init__(self, system: System) -> None:
        from pypardiso import PyPardisoSolver

        self._system = system
        self.n_tets, self.unknowns = system.n_tets, len(system.loads)
        if system.order == 2:
            self.name += ", scikit-fem P2"
        upper = sp.triu(system.matrix).tocsr()
        upper.sort_indices()
        self._data = upper.data.astype(np.float32) / np.float32(upper.data.max())
        self._loads = np.asfortranarray(system.loads / upper.data.max(), dtype=np.float32)
        self._first, self._columns = upper.indptr.astype(np.int32), upper.indices.astype(np.int32)
        self._solver = PyPardisoSolver(mtype=2)
        for place, value in ((1, 1), (2, 2), (28, 1), (35, 1)):
            self._solver.iparm[place - 1] = value
        self._call(11, self._data)

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        held = self._system.held(x, gap)
        data = self._data.copy()
        data[self._first[:-1][held]] *= np.float32(HOLD)  # the diagonal comes first in a row
        self._call(22, data)
        potentials = self._call(33, data)
        return self._system.fixed_energy - self._system.loads.T @ potentials

    def _call(self, phase: int, data: NDArray[np.float32]) -> NDArray[np.float32]:
        out = np.empty_like(self._loads)
        number, reference = ctypes.c_int32, ctypes.byref
        failed = number(0)
        integers, handle = ctypes.POINTER(number), ctypes.POINTER(self._solver._pt_type[0])
        self._solver._mkl_pardiso(
            self._solver.pt.ctypes.data_as(handle), reference(number(1)), reference(number(1)),
            reference(number(2)), reference(number(phase)), reference(number(len(self._loads))),
            data.ctypes.data, self._first.ctypes.data_as(integers),
            self._columns.ctypes.data_as(integers), self._solver.perm.ctypes.data_as(integers),
            reference(number(self._loads.shape[1])), self._solver.iparm.ctypes.data_as(integers),
            reference(number(0)), self._loads.ctypes.data, out.ctypes.data, reference(failed),
        )  # fmt: skip
        if failed.value:
            raise RuntimeError(f"PARDISO failed in phase {phase} with error {failed.value}")
        return out

    def close(self) -> None:
        """Release the factor."""
        self._call(-1, self._data)


class Cholmod:
    """SuiteSparse CHOLMOD through scikit-sparse: supernodal, numeric refactorisation."""

    name = "CHOLMOD"
    settings = "scikit-sparse, supernodal LLᵀ, best ordering of CHOLMOD, cholesky_inplace each step"

    def __init__(self, system: System) -> None:
        from sksparse.cholmod import analyze

        self._system = system
        self.n_tets, self.unknowns = system.n_tets, len(system.loads)
        self._lower = sp.tril(system.matrix).tocsc()
        self._lower.sort_indices()
        self._data = self._lower.data.copy()
        self._factor = analyze(self._lower, mode="supernodal", ordering_method="best")

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        held = self._system.held(x, gap)
        self._lower.data[:] = self._data
        self._lower.data[self._lower.indptr[:-1][held]] *= HOLD  # the diagonal comes first
        self._factor.cholesky_inplace(self._lower)
        potentials = self._factor(self._system.loads)
        return self._system.fixed_energy - self._system.loads.T @ potentials
