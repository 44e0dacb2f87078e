"""Files that list the taxels of a skin: CSV tables, and the position files of iCub's skins."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._validate import UNITS, read_file
from capsense.errors import SceneError

Array = NDArray[np.float64]

_COLUMNS = ("x", "y", "z", "nx", "ny", "nz")
_SECTION = "[calibration]"


class Taxels(NamedTuple):
    """Taxels of a file."""

    names: list[str]
    positions: Array
    """[m], shape (n, 3)."""
    normals: Array
    """Unit normals, shape (n, 3)."""
    left_out: dict[str, str]
    """Lines that hold no taxel of their own, and why."""


def read_taxels(path: Path, unit: str) -> Taxels:
    """Read a ``.csv`` file, or a ``.txt`` or ``.ini`` file with a ``[calibration]`` section.

    Raises:
        SceneError: The file cannot be read, or a line is wrong; the message names file, line, and
            fix.
    """
    if path.suffix.lower() not in (".csv", ".txt", ".ini"):
        raise SceneError(f"{path} is no .csv, .txt or .ini file; give a table of taxels")
    if unit not in UNITS:
        raise SceneError(f"unit is {unit!r}; give one of {', '.join(UNITS)}")
    try:
        text = read_file(path).decode()
    except FileNotFoundError:
        raise SceneError(f"there is no taxel file {path}; check the path") from None
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SceneError(f"{path} is not a text file; export the table as text") from None
    lines = text.splitlines()
    rows = _csv_rows(path, lines) if path.suffix.lower() == ".csv" else _sections(path, lines)
    return checked_taxels(rows, UNITS[unit], str(path))


def checked_taxels(rows: list[tuple[str, str, list[float]]], scale: float, source: str) -> Taxels:
    """Taxels from rows of (place for messages, name, six numbers).

    Rows of zeros stand for taxels that are not there. Of several at one place the first is kept.

    Raises:
        SceneError: A number is not finite, a normal has no length, a name repeats, or nothing is
            left.
    """
    names: list[str] = []
    kept: list[list[float]] = []
    out: dict[str, str] = {}
    taken: dict[tuple[float, ...], str] = {}
    for place, name, values in rows:
        if not np.isfinite(values).all():
            raise SceneError(f"{place}: {values} are not all finite; correct the line")
        if name in names or name in out:
            raise SceneError(f"{place}: there are two taxels named {name!r}; rename one")
        if not any(values):
            out[name] = "a line of zeros, no taxel"
            continue
        if np.linalg.norm(values[3:]) < 1e-6:
            raise SceneError(f"{place}: the normal {values[3:]} has no length; correct the line")
        at = tuple(values[:3])
        if at in taken:
            out[name] = f"at the place of {taken[at]!r}"
            continue
        taken[at] = name
        names.append(name)
        kept.append(values)
    if not kept:
        raise SceneError(f"{source} holds no taxel; give lines of x, y, z, nx, ny, nz")
    table = np.array(kept, dtype=float)
    normals = table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    positions = table[:, :3] * scale
    if np.abs(positions).max() > 10.0:
        raise SceneError(
            f"{source}: taxels are up to {np.abs(positions).max():.3g} m away; set unit, such as "
            "unit='mm'"
        )
    return Taxels(names, positions, normals, out)


def _csv_rows(path: Path, lines: list[str]) -> list[tuple[str, str, list[float]]]:
    table = csv.reader(lines)
    header = [cell.strip().lower() for cell in next(table, [])]
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise SceneError(
            f"{path}, line 1: there is no column {missing[0]!r}; the header must name "
            f"{', '.join(_COLUMNS)}, and may name 'name'"
        )
    out: list[tuple[str, str, list[float]]] = []
    for cells in table:
        place = f"{path}, line {table.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise SceneError(f"{place}: there are {len(cells)} cells, not {len(header)}")
        row = dict(zip(header, cells, strict=True))
        values = _floats(place, [row[name] for name in _COLUMNS])
        out.append((place, row.get("name", "").strip() or f"taxel_{len(out)}", values))
    return out


def _sections(path: Path, lines: list[str]) -> list[tuple[str, str, list[float]]]:
    """The lines after ``[calibration]``, numbered from 0 as the taxels of the skin are."""
    bare = [line.strip() for line in lines]
    if _SECTION not in (line.lower() for line in bare):
        raise SceneError(
            f"{path} has no {_SECTION} section, which lists x y z nx ny nz of each taxel; files "
            "that only list triangles hold no positions"
        )
    start = [line.lower() for line in bare].index(_SECTION) + 1
    out: list[tuple[str, str, list[float]]] = []
    for number, line in enumerate(bare[start:], start=start + 1):
        if line.startswith("["):
            break
        words = line.split("#")[0].split()
        if not words or (not out and words[0].isalpha()):
            continue
        place = f"{path}, line {number}"
        if len(words) != 6:
            raise SceneError(f"{place}: there are {len(words)} numbers; give x y z nx ny nz")
        out.append((place, f"taxel_{len(out)}", _floats(place, words)))
    return out


def _floats(place: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise SceneError(f"{place}: {' '.join(words)!r} are not all numbers; correct it") from None
