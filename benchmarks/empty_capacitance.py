"""What a Maxwell matrix alone costs beside a field: ``python benchmarks/empty_capacitance.py``.

Sweeps without bodies need the matrix of the empty domain only. Both ways agree to the last bit.
Times are of the processor, all threads of one process; the kernels are compiled before.
"""

from __future__ import annotations

import platform
import sys
import time

import numpy as np

from capsense.design import load_design
from capsense.field.background import BuildSettings, build_background, empty_capacitance

DESIGNS = ("stripe", "six_patch_bare")


def main(names: tuple[str, ...]) -> None:
    """Print a line for each design and resolution."""
    print(f"{platform.processor() or platform.machine()}; design, resolution, panels, seconds")
    build_background(load_design("stripe"), BuildSettings(panel_scale=8.0))
    for name in names:
        design = load_design(name)
        for resolution in (0.25, 1.0):
            settings = BuildSettings().refined(resolution)
            start = time.process_time()
            matrix = empty_capacitance(design, settings)
            middle = time.process_time()
            field = build_background(design, settings)
            end = time.process_time()
            same = np.array_equal(matrix, field.capacitance)
            alone, whole = middle - start, end - middle
            print(
                f"{name:15s} {resolution:4g} {field.n_panels:6d} panels: matrix {alone:6.2f} s, "
                f"field {whole:6.2f} s, {whole / alone:5.1f} times; equal: {same}",
                flush=True,
            )


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or DESIGNS)
