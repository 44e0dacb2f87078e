"""What a first use takes: import, first reading without and with compiled kernels, warm-up.

    python benchmarks/first_use.py             # about four minutes
    python benchmarks/first_use.py --no-warmup

Each row is a process of its own; times are its processor time, and by the clock. The cache of
compiled kernels is an empty temporary folder (``NUMBA_CACHE_DIR``), yours is not touched.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile

from machine import describe_machine

IMPORT = "import capsense as cs"
READING = """
scene = cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.08)))])
cs.Simulator("six_patch_bare").step(scene)
"""
WARMUP = "from capsense.__main__ import main\nmain(['warmup', '--quiet'])"
TIMED = """
import time
processor, clock = time.process_time(), time.perf_counter()
{}
print(time.process_time() - processor, time.perf_counter() - clock)
"""


def seconds(program: str, cache: str) -> tuple[float, float]:
    """Processor time, and time by the clock, of a program in a process of its own [s]."""
    done = subprocess.run(
        [sys.executable, "-c", TIMED.format(program)],
        env={**os.environ, "NUMBA_CACHE_DIR": cache},
        stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    processor, clock = done.stdout.split()[-2:]
    return float(processor), float(clock)


def main() -> None:
    """Print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--no-warmup", action="store_true", help="leave `capsense warmup` out")
    options = parser.parse_args()
    print(describe_machine(("numpy", "numba"))["processor"])
    print("                                    processor [s]  clock [s]")
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        rows = [
            ("import", IMPORT, first),
            ("import, first reading, empty cache", IMPORT + READING, first),
            ("the same, filled cache", IMPORT + READING, first),
        ]
        if not options.no_warmup:
            rows.append(("capsense warmup, empty cache", WARMUP, second))
        for name, program, cache in rows:
            processor, clock = seconds(program, cache)
            print(f"{name:36}{processor:13.2f}  {clock:9.2f}", flush=True)


if __name__ == "__main__":
    main()
