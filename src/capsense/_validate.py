"""Strict reading of TOML files: every key, type, unit and number is checked as it is read; and
what counts as a whole number or a number anywhere."""

from __future__ import annotations

import difflib
import errno
import math
import stat
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from capsense._file_kinds import other_kind
from capsense.errors import CapSenseError

MAX_LENGTH = 10.0
"""No length in a file may exceed this [m]."""
MIN_LENGTH = 1e-8
"""No size in a file may be smaller than this [m]."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
"""Metres to the unit of a geometry file."""


def as_number(value: object) -> float:
    """A real number as a float; NaN for anything else, booleans too; infinity beyond floats."""
    if isinstance(value, Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return math.nan


def checked_frequency(value: object) -> float:
    """An excitation frequency [Hz].

    Raises:
        ValueError: It is no positive number.
    """
    if not 0 < (number := as_number(value)) < math.inf:
        raise ValueError(f"excitation_frequency is {shorten(value)}; give a positive number of Hz")
    return number


def as_whole(value: object) -> int | None:
    """A whole number, Python's or NumPy's; None for anything else, booleans too."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None


SYNONYMS = (
    ("disc", "disk", "circle", "circular", "round", "dot"),
    ("rectangle", "square", "box", "cuboid", "cube", "brick", "block", "plate", "rect"),
    ("ring", "annulus", "donut", "washer", "hoop"),
    ("sphere", "ball", "orb"),
    ("ellipsoid", "spheroid", "egg"),
    ("capsule", "pill", "rod", "limb", "stadium"),
    ("cylinder", "tube", "pipe", "can"),
    ("comb", "interdigitated", "interdigital", "idt"),
    ("meander", "serpentine", "zigzag", "zig-zag", "snake"),
    ("stripes", "strips", "bars", "lines", "grating"),
    ("polygon", "outline", "triangle", "hexagon", "path"),
    ("grounded", "ground", "gnd", "earth", "earthed"),
    ("floating", "ungrounded", "isolated", "insulated", "float"),
)
"""Words for one thing. Which of them is valid differs from place to place."""


def nearest(word: str, options: Iterable[str]) -> str | None:
    """The option most like ``word``, by meaning or by spelling; None if none is like it.

    A slip of one letter or two is looked for first, then another word for the same.
    """
    typed, valid = word.lower(), list(options)
    slip = difflib.get_close_matches(typed, valid, n=1, cutoff=0.8)
    same = [o for words in SYNONYMS if typed in words for o in words if o in valid]
    loose = difflib.get_close_matches(typed, valid, n=1, cutoff=0.5)
    return next(iter([*slip, *same, *loose]), None)


def suggest(word: str, options: Iterable[str]) -> str:
    """A sentence part that names the nearest valid option, and all of them."""
    valid = list(options)
    close = nearest(word, valid)
    hint = f"did you mean {close!r}? " if close else ""
    return f"{hint}valid are {', '.join(valid)}"


def read_toml(
    path: Path, what: str, error: type[CapSenseError], *, hint: str = ""
) -> dict[str, Any]:
    """The content of a TOML file.

    Args:
        path: The file.
        what: What it is, for messages, such as ``design``.
        error: The exception to raise.
        hint: A further fix for a file that is not there.

    Raises:
        CapSenseError: An ``error`` that names the path, if it is missing, unreadable or not TOML.
    """
    try:
        data = tomllib.loads(read_file(path).decode())
    except FileNotFoundError:
        raise error(f"there is no {what} file {path}; check the path{hint}") from None
    except OSError as cause:
        raise error(f"{path} cannot be read: {cause.strerror}; give a .toml file") from None
    except (ValueError, RecursionError) as cause:
        other = other_kind(path, what)
        raise error(
            other or f"{path} is not valid TOML: {cause}; correct the line it names"
        ) from None
    if other := other_kind(path, what, data):
        raise error(f"{other}; give a {what} file")
    return data


def read_file(path: Path) -> bytes:
    """The content of a file, which must have an end.

    Raises:
        OSError: It cannot be read, or is a device.
    """
    mode = path.stat().st_mode
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
        raise OSError(errno.EINVAL, "it is a device and no file", str(path))
    return path.read_bytes()


class Table:
    """One table of a file, with readers that refuse what is not as it should be.

    Subclasses set :attr:`error_type` to the exception of their kind of file.

    Args:
        data: The raw table.
        source: Name of the file, for messages.
        item: What the table describes, for messages, such as ``electrode "E1"``.
        limit: Largest plausible length [m], such as the domain's longest edge.
    """

    error_type: ClassVar[type[CapSenseError]] = CapSenseError
    """What is raised for anything that is wrong."""

    def __init__(self, data: Any, source: str, item: str, limit: float = MAX_LENGTH) -> None:
        self.source = source
        self.item = item
        self.limit = min(limit, MAX_LENGTH)
        if not isinstance(data, Mapping):
            raise self.error(f"must be a table of key = value lines, not {shorten(data)}")
        self.data: Mapping[str, Any] = data

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def error(self, message: str) -> CapSenseError:
        """An error of :attr:`error_type` that names the file and the item."""
        return self.error_type(f"{self.source}: {self.item}: {message}")

    def only(self, keys: Iterable[str]) -> None:
        """Refuse keys that are not in ``keys``, naming the nearest valid one."""
        valid = list(keys)
        for key in self.data:
            if key not in valid:
                raise self.error(f"unknown key {key!r}; {suggest(key, valid)}")

    def needs(self, *keys: str) -> None:
        """Name all of ``keys`` that are missing, if there are several; the reader of a single one
        says what it takes."""
        missing = [repr(key) for key in keys if key not in self.data]
        if len(missing) > 1:
            raise self.error(f"missing keys {', '.join(missing[:-1])} and {missing[-1]}; add them")

    def raw(self, key: str, expected: str) -> Any:
        """The value of a mandatory key."""
        if key not in self.data:
            raise self.error(f"missing key {key!r}; add {key} = {expected}")
        return self.data[key]

    def string(self, key: str, default: str | None = None) -> str:
        """A non-empty string."""
        if default is not None and key not in self.data:
            return default
        value = self.raw(key, '"…"')
        if not isinstance(value, str) or not value.strip():
            raise self.error(f"{key} = {shorten(value)} must be a non-empty string in quotes")
        return value

    def text(self, key: str) -> str:
        """An optional string, empty by default."""
        value = self.data.get(key, "")
        if not isinstance(value, str):
            raise self.error(f"{key} = {shorten(value)} must be a string in quotes")
        return value.strip()

    def choice(self, key: str, options: Sequence[str], default: str | None = None) -> str:
        """A string that is one of ``options``."""
        if default is not None and key not in self.data:
            return default
        value = self.raw(key, " | ".join(f'"{o}"' for o in options))
        if not isinstance(value, str) or value not in options:
            word = value if isinstance(value, str) else ""
            raise self.error(f"{key} = {shorten(value)} is not known; {suggest(word, options)}")
        return value

    def boolean(self, key: str, default: bool) -> bool:
        """``true`` or ``false``."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            raise self.error(f"{key} = {shorten(value)} must be true or false")
        return value

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """An integer from ``low`` to ``high``."""
        if default is not None and key not in self.data:
            return default
        value = self.raw(key, f"an integer from {low} to {high}")
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.error(f"{key} = {shorten(value)} must be an integer from {low} to {high}")
        return value

    def number(
        self, key: str, low: float, high: float, default: float | None = None, unit: str = ""
    ) -> float:
        """A finite number from ``low`` to ``high``."""
        if default is not None and key not in self.data:
            return default
        span = f"from {low:g} to {high:g}{unit and ' ' + unit}"
        value = self._finite(key, self.raw(key, f"a number {span}"))
        if not low <= value <= high:
            raise self.error(f"{key} = {value:g} must be {span}")
        return value

    def numbers(self, key: str, count: Sequence[int], what: str) -> tuple[float, ...]:
        """An array of finite numbers; ``count`` lists the lengths allowed."""
        return self._array(key, self.raw(key, what), count, what)

    def length(self, key: str, default: float | None = None, *, zero: bool = False) -> float:
        """A length [m], positive unless ``zero`` also allows 0."""
        if default is not None and key not in self.data:
            return default
        value = self._finite(key, self.raw(key, "a length in metres"))
        self._size(key, value, zero=zero)
        return value

    def sizes(self, key: str, count: int, what: str) -> tuple[float, ...]:
        """``count`` positive lengths [m]."""
        values = self._array(key, self.raw(key, what), (count,), what)
        for value in values:
            self._size(key, value)
        return values

    def coordinates(
        self, key: str, count: Sequence[int], default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """Coordinates [m] of either sign; ``count`` lists the numbers of axes allowed."""
        if default is not None and key not in self.data:
            return default
        what = " or ".join("[" + ", ".join("xyz"[:n]) + "]" for n in count) + " in metres"
        values = self._array(key, self.raw(key, what), count, what)
        for value in values:
            self.plausible(key, value)
        return values

    def coordinate(self, key: str, default: float | None = None) -> float:
        """One coordinate [m] of either sign."""
        if default is not None and key not in self.data:
            return default
        value = self._finite(key, self.raw(key, "a coordinate in metres"))
        self.plausible(key, value)
        return value

    def interval(self, key: str) -> tuple[float, float]:
        """A rising pair of coordinates [low, high] [m]."""
        what = "[low, high] in metres"
        low, high = self._array(key, self.raw(key, what), (2,), what)
        self.plausible(key, low)
        self.plausible(key, high)
        if not high - low >= MIN_LENGTH:
            raise self.error(f"{key} = [{low:g}, {high:g}] must rise; write [low, high] in metres")
        return low, high

    def points(self, key: str, least: int) -> list[tuple[float, float]]:
        """A list of [x, y] points [m], at least ``least`` of them."""
        value = self.raw(key, f"a list of at least {least} [x, y] points in metres")
        return self.point_list(key, value, least)

    def point_list(self, key: str, value: Any, least: int) -> list[tuple[float, float]]:
        """Check one list of [x, y] points [m]."""
        if not isinstance(value, list) or len(value) < least:
            raise self.error(
                f"{key} = {shorten(value)} must be a list of at least {least} [x, y] points in m"
            )
        out: list[tuple[float, float]] = []
        for number, point in enumerate(value):
            name = f"{key}[{number}]"
            x, y = self._array(name, point, (2,), "[x, y] in metres")
            self.plausible(name, x)
            self.plausible(name, y)
            out.append((x, y))
        return out

    def vectors(self, key: str, width: int, what: str) -> list[tuple[float, ...]]:
        """A list of arrays of ``width`` finite numbers; a single such array counts as one."""
        value = self.raw(key, f"a list of {what}")
        if not isinstance(value, list) or not value:
            raise self.error(f"{key} = {shorten(value)} must be a list of {what}")
        rows = value if isinstance(value[0], list) else [value]
        return [self._array(f"{key}[{n}]", row, (width,), what) for n, row in enumerate(rows)]

    def series(self, key: str, low: float, high: float, unit: str) -> list[float] | float:
        """A number from ``low`` to ``high``, or a list of such numbers."""
        value = self.raw(key, f"a number from {low:g} to {high:g} {unit}, or a list of them")
        many = isinstance(value, list)
        out = []
        for n, item in enumerate(value if many else [value]):
            name = f"{key}[{n}]" if many else key
            number = self._finite(name, item)
            if not low <= number <= high:
                raise self.error(f"{name} = {number:g} must be from {low:g} to {high:g} {unit}")
            out.append(number)
        return out if many else out[0]

    def pairs(self, key: str, what: str, names: Sequence[str], owner: str) -> list[tuple[str, str]]:
        """An optional list of pairs of electrodes; ``what`` describes it, for messages."""
        value = self.data.get(key)
        if value is None:
            return []
        if not isinstance(value, list) or not value:
            raise self.error(f"{key} = {shorten(value)} must be {what}")
        for number, pair in enumerate(value):
            at = f"{key}[{number}] = {shorten(pair)}"
            if not isinstance(pair, list) or [type(name) for name in pair] != [str, str]:
                raise self.error(f"{at} must be two electrode names")
            for name in pair:
                if name not in names:
                    raise self.error(
                        f"{at} names no electrode {name!r} of {owner}; {suggest(name, names)}"
                    )
        return [(one, two) for one, two in value]

    def unit_quaternions(self, key: str) -> list[tuple[float, ...]]:
        """A quaternion (x, y, z, w), or a list of such, each of length 1 to a thousandth."""
        rows = self.vectors(key, 4, "[x, y, z, w]")
        for row in rows:
            norm = math.hypot(*row)
            if abs(norm - 1.0) > 1e-3:
                raise self.error(
                    f"{key} = {list(row)} has length {norm:.4g}; give a unit quaternion "
                    "[x, y, z, w]"
                )
        return rows

    def tables(self, key: str) -> list[Any]:
        """An optional array of tables."""
        value = self.data.get(key, [])
        if not isinstance(value, list):
            raise self.error(f"{key!r} must be an array of tables; write [[{key}]]")
        return value

    def plausible(self, key: str, value: float) -> None:
        """Refuse a length that only makes sense in millimetres."""
        if abs(value) > self.limit:
            raise self.error(
                f"{key} = {value:g} is larger than {self.limit:g} m, the largest length that can "
                f"be meant here; lengths are metres; did you mean {value * 1e-3:g}?"
            )

    def _size(self, key: str, value: float, *, zero: bool = False) -> None:
        self.plausible(key, value)
        if zero and value == 0.0:
            return
        if value <= 0.0:
            raise self.error(f"{key} = {value:g} must be positive, in metres")
        if value < MIN_LENGTH:
            raise self.error(
                f"{key} = {value:g} is less than a micrometre; give the length in metres"
            )

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(
                f"{key} = {shorten(value)} must be a number without quotes or brackets"
            )
        number = as_number(value)
        if not math.isfinite(number):
            raise self.error(f"{key} = {number} must be a finite number")
        return number

    def _array(self, key: str, value: Any, count: Sequence[int], what: str) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) not in count:
            raise self.error(f"{key} = {shorten(value)} must be {what}")
        return tuple(self._finite(key, v) for v in value)


def chosen_rows(environments: object, count: int, error: type[CapSenseError]) -> NDArray[np.int64]:
    """Numbers of environments, in the order given, shape (k,).

    Args:
        environments: Numbers, a mask of shape (e,), or None for all.
        count: How many there are, e.
        error: Raised where there is no such environment, or the mask is of another length.
    """
    if environments is None:
        return np.arange(count)
    try:
        rows = np.asarray(environments)
    except (TypeError, ValueError, RuntimeError):
        rows = np.array(None)
    if rows.dtype == np.bool_ and rows.shape == (count,):
        return np.flatnonzero(rows)
    rows = rows.ravel()
    if not rows.size:
        return np.zeros(0, np.int64)
    if rows.dtype.kind not in "iu" or rows.min() < 0 or rows.max() >= count:
        raise error(
            f"environments is {shorten(environments)}; give numbers from 0 to {count - 1}, or a "
            f"mask of {count}"
        )
    return rows.astype(np.int64)


def shorten(value: Any) -> str:
    """``repr`` of a value, cut to 60 characters."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        text = f"a {type(value).__name__} too long to print"
    return text if len(text) <= 60 else text[:57] + "…"
