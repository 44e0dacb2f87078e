"""What hand-written parts of the step are worth beside their plain alternatives.

    python benchmarks/kernels.py             # all, on one core, about two minutes
    python benchmarks/kernels.py cholesky    # factors and solutions against LAPACK
    python benchmarks/kernels.py memory      # memory that stays with the process, or does not

Both sides run in turn within one process, or in processes that are started in turn. Medians.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median

import numpy as np
from machine import describe_machine, on_one_core
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from capsense import _dense
from capsense._jit import compiled

SIZES, SIDES, ROUNDS = (24, 48, 80, 160, 320, 640), 8, 30
"""Unknowns of steps of one small body to those of many; terminals, padded."""
PROGRAM = """
import sys, time
from statistics import median
import capsense as cs
from capsense.bench import moving_bar, moving_limbs
from capsense.solver import surface_solver
if sys.argv[1] == "off":
    surface_solver._keep_memory = lambda: None
for move in (moving_bar, moving_limbs):
    sim, times = cs.Simulator("six_patch"), []
    for k in range(120):
        scene = move(k)
        start = time.perf_counter()
        sim.step(scene)
        times.append(time.perf_counter() - start)
    print(1e3 * median(times[20:]))
"""


@compiled
def ours(matrix, sides):  # type: ignore[no-untyped-def]
    """The step's own factor and solution."""
    found = _dense.cholesky(matrix)
    _dense.substitute(matrix, sides)
    return found


def lapack(matrix: NDArray[np.float64], sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same by LAPACK."""
    factor, _ = dpotrf(matrix, clean=0)
    return np.asarray(dpotrs(factor, sides)[0])


def cholesky() -> None:
    """Print medians for some sizes."""
    print("unknowns  ours [us]  LAPACK [us]  ratio  largest difference")
    rng = np.random.default_rng(1)
    for n in SIZES:
        half = rng.normal(size=(n, n))
        whole = half @ half.T + n * np.eye(n)
        right = rng.normal(size=(n, SIDES))
        wide = np.zeros((n, _dense.whole_lines(n)))
        times: tuple[list[float], list[float]] = ([], [])
        for _ in range(ROUNDS):
            wide[:, :n] = whole
            sides = right.copy()
            times[0].append(_seconds(lambda w=wide, s=sides: ours(w, s)))
            expected = lapack(whole, right)
            times[1].append(_seconds(lambda w=whole, s=right: lapack(w, s)))
        one, two = (1e6 * median(t) for t in times)
        off = np.abs(sides - expected).max() / np.abs(expected).max()
        print(f"{n:8d}  {one:9.0f}  {two:11.0f}  {one / two:5.2f}  {off:18.1e}")


def _seconds(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def memory() -> None:
    """Print medians of steps in processes that keep freed memory, and that do not."""
    found: dict[str, list[list[float]]] = {"on": [], "off": []}
    for _ in range(3):
        for state, values in found.items():
            run = [sys.executable, "-c", PROGRAM, state]
            done = subprocess.run(run, capture_output=True, text=True, check=True)
            values.append([float(line) for line in done.stdout.split()])
    print("scene          kept [ms]  given back [ms]  ratio")
    for k, name in enumerate(("bar", "twelve limbs")):
        on, off = (median(v[k] for v in found[state]) for state in ("on", "off"))
        print(f"{name:13}  {on:9.2f}  {off:15.2f}  {on / off:5.2f}")


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", nargs="?", choices=("cholesky", "memory"))
    options = parser.parse_args()
    on_one_core()
    print(describe_machine(("numpy", "scipy", "numba"))["processor"])
    for name, run in (("cholesky", cholesky), ("memory", memory)):
        if options.what in (None, name):
            run()


if __name__ == "__main__":
    main()
