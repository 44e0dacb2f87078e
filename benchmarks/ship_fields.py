"""Build the fields that come with the package: ``python benchmarks/ship_fields.py``.

Run it whenever a packaged design, a default setting or the numerics have changed; the test suite
says when. An interrupted run goes on at the field where it stopped, if the code is the same.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from capsense import field
from capsense.design import available_designs, load_design, parse_design
from capsense.errors import FieldError
from capsense.field.background import BuildSettings, build_background
from capsense.field.cache import (
    cache_key,
    default_cache_dir,
    default_settings,
    load_or_build,
    read_arrays,
    save_background,
)
from capsense.field.green_points import GreenSettings

COMMAND = "python benchmarks/ship_fields.py"
SOURCES = Path(field.__file__ or "").parent
FOLDER = SOURCES / "shipped"
SIZE_LIMIT = 20_000_000
"""All shipped fields together stay below this [bytes]."""
_SAME, _SAME_FIT = 1e-5, 3e-3
"""Relative difference that compilers and processors may make: of fingerprints, and of the figures
in them that come from a fit."""
_FITTED = 9
"""How many these are, at the end of a fingerprint."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Shipped:
    """What was written for one design."""

    path: Path
    size: int
    """Size of the file [bytes]."""


def ship(
    names: Sequence[str],
    folder: Path = FOLDER,
    *,
    settings: BuildSettings | None = None,
    cache_dir: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[Shipped]:
    """Build the fields of packaged designs and write them to ``folder`` in compact form.

    Files of designs that are no longer packaged, or that have become stale, are removed.
    ``cache_dir`` holds what is built until all is written.
    """
    work = cache_dir or default_cache_dir() / f"ship-{_source_hash()}"
    folder.mkdir(parents=True, exist_ok=True)
    note = {"fingerprint": fingerprint()}
    out = []
    for name in names:
        design = load_design(name)
        chosen = settings or default_settings(design)
        key = cache_key(design, chosen)

        def tell(stage: str, fraction: float, name: str = name) -> None:
            if progress is not None:
                progress(f"{name}: {stage}", fraction)

        found = load_or_build(design, chosen, cache_dir=work, shipped=False, progress=tell)
        for old in folder.glob(f"{name}-{'?' * 32}.npz"):
            old.unlink()
        path = folder / f"{name}-{key}.npz"
        save_background(found, path, key, compact=True, note=note)
        out.append(Shipped(path, path.stat().st_size))
        _log.info("%s: %.2f MB", path.name, out[-1].size / 1e6)
    for file in folder.glob("*.npz"):
        if file.name.rpartition("-")[0] not in available_designs():
            file.unlink()
    shutil.rmtree(work, ignore_errors=True)
    return out


def stale(folder: Path = FOLDER, settings: BuildSettings | None = None) -> list[str]:
    """Return what is wrong with the shipped fields, a line each; nothing if all is well."""
    wrong = []
    wanted = {}
    for name in available_designs():
        design = load_design(name)
        wanted[f"{name}-{cache_key(design, settings or default_settings(design))}.npz"] = name
    present = {file.name for file in folder.glob("*.npz")}
    wrong += [f"{wanted[file]}: not shipped" for file in sorted(wanted.keys() - present)]
    wrong += [f"{file}: of no packaged design" for file in sorted(present - wanted.keys())]
    now = np.array(fingerprint())
    for file in sorted(present & wanted.keys()):
        key = file.removesuffix(".npz").rpartition("-")[2]
        try:
            _, meta = read_arrays(folder / file, kind="field", key=key)
        except FieldError as error:
            wrong.append(str(error))
            continue
        then = np.array(meta.get("fingerprint", ()))
        same = then.shape == now.shape and np.allclose(then, now, rtol=_SAME_FIT, atol=0.0)
        if not same or not np.allclose(then[:-_FITTED], now[:-_FITTED], rtol=_SAME, atol=0.0):
            wrong.append(
                f"{file}: built by other numerics; raise NUMERICS in capsense.field.background, "
                "for cached fields are stale too"
            )
    size = sum(file.stat().st_size for file in folder.glob("*.npz"))
    if size > SIZE_LIMIT:
        wrong.append(f"{size / 1e6:.1f} MB in total, at most {SIZE_LIMIT / 1e6:.0f} MB are wanted")
    return wrong


def fingerprint() -> list[float]:
    """Figures of a tiny design's field, which change whenever the numerics do."""
    design = parse_design(
        {
            "name": "fingerprint",
            "domain": {"size": [0.08, 0.08, 0.08], "backplane": 0.01},
            "electrode": [
                {"name": "E1", "shape": "rectangle", "size": [0.02, 0.02], "center": [-0.015, 0.0]},
                {"name": "E2", "shape": "disc", "radius": 0.008, "center": [0.015, 0.0]},
            ],
            "layer": [{"name": "plate", "eps_r": 3.0, "size": [0.06, 0.04], "z": [-0.002, 0.0]}],
        }
    )
    found = build_background(design, BuildSettings(panel_scale=8.0))
    points = np.array([[-0.015, 0.0, 0.003], [0.015, 0.0, 0.01], [0.0, 0.0, 0.02]])
    potentials = found.green.phi0(points)
    answers = np.diag(found.green.g(points, points))
    rough = (found.n_panels, *found.capacitance.ravel())
    sizes = chain.from_iterable(np.ravel(v).tolist() for v in astuple(GreenSettings()))
    fitted = (*potentials.ravel(), *answers)
    assert len(fitted) == _FITTED
    return [float(f"{value:.8e}") for value in (*rough, *sizes, *fitted)]


def _source_hash() -> str:
    """Hash of the code that builds fields; unlike the cache key it sees every edit."""
    digest = hashlib.sha256()
    for file in sorted(SOURCES.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


class _Lines:
    """Progress as log lines, one for every tenth."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, stage: str, fraction: float) -> None:
        line = f"{int(10 * fraction) / 10:4.0%} {stage}"
        if line != self._last:
            _log.info("%s", line)
        self._last = line


def main(argv: Sequence[str] | None = None) -> int:
    """Ship all packaged designs, or the named ones, or check what is shipped."""
    logging.basicConfig(stream=sys.stdout, level=logging.INFO, format="%(message)s")
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("names", nargs="*", help="packaged designs; all by default")
    parser.add_argument("--check", action="store_true", help="only say what is stale")
    options = parser.parse_args(argv)
    unknown = sorted(set(options.names) - set(available_designs()))
    if unknown:
        parser.error(f"no packaged design is named {unknown[0]!r}")
    if not options.check:
        ship(options.names or available_designs(), progress=_Lines())
    wrong = stale()
    for line in wrong:
        _log.info("%s", line)
    size = sum(file.stat().st_size for file in FOLDER.glob("*.npz"))
    _log.info("%d fields, %.2f MB", len(list(FOLDER.glob("*.npz"))), size / 1e6)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
