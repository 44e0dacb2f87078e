"""Numbers as a readout takes them: what is none, not finite or of the wrong size is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def require(
    owner: str, name: str, value: object, low: float, unit: str, *, open_: bool = False
) -> None:
    """Refuse what is no finite number, or below ``low`` (or at it, if ``open_``)."""
    number = as_number(value)
    if not math.isfinite(number) or number < low or (open_ and number == low):
        bound = f"above {low:g}" if open_ else f"at least {low:g}"
        wanted = "a finite number" if low == -math.inf else f"a number {bound} {unit}".rstrip()
        raise ReadoutError(f"{owner}: {name} is {value!r}; give {wanted}")


def require_positive(owner: str, item: object, **units: str) -> None:
    """Refuse attributes of an item, by name with their units, that are no finite number above 0."""
    for name, unit in units.items():
        require(owner, name, getattr(item, name), 0.0, unit, open_=True)


def require_whole(owner: str, name: str, value: object, low: int, high: float = math.inf) -> None:
    """Refuse what is no whole number from ``low`` to ``high``."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not low <= as_number(value) <= high:
        bound = f"from {low} on" if high == math.inf else f"from {low} to {high}"
        raise ReadoutError(f"{owner}: {name} is {value!r}; give a whole number {bound}")


def real(what: str, values: object) -> Array:
    """Real numbers as an array of any shape.

    Raises:
        ReadoutError: They are not; ``what`` names them.
    """
    try:
        array = np.asarray(values)
    except ValueError:
        raise ReadoutError(f"{what}: rows differ in length; make them the same") from None
    if array.dtype.kind not in "fiu":
        raise ReadoutError(f"{what}: {array.dtype} values are no real numbers; give such")
    return np.asarray(array, dtype=float)


def phasors(what: str, values: object) -> NDArray[Any]:
    """Real or complex numbers as an array of any shape.

    Raises:
        ReadoutError: They are neither; ``what`` names them.
    """
    if isinstance(values, np.ndarray) and values.dtype == complex:
        return values
    return real(what, values)


def finite(what: str, values: object) -> Array:
    """Finite real numbers as an array of any shape.

    Raises:
        ReadoutError: They are not; ``what`` names them.
    """
    array = real(what, values)
    if not np.isfinite(array).all():
        raise ReadoutError(f"{what}: a number is not finite; leave it out, or correct it")
    return array


def per_channel(owner: str, name: str, value: object, channels: int) -> Array:
    """One number for all channels, or one per channel, as an array of shape (K,).

    Raises:
        ReadoutError: The count does not fit, or a number is not finite.
    """
    return spread(owner, name, value, (channels,))


def spread(owner: str, name: str, value: object, shape: tuple[int, ...]) -> Array:
    """A number for all, or an array of the last axes of ``shape``, as an array of that shape.

    Axes of length 1 stand for any length where there are several.

    Raises:
        ReadoutError: The count does not fit, or a number is not finite.
    """
    array = finite(f"{owner}: {name}", value)
    last = shape[len(shape) - array.ndim :]
    fits = array.ndim <= len(shape) and all(
        given in (wanted, 1 if len(shape) > 1 else wanted)
        for given, wanted in zip(array.shape, last, strict=True)
    )
    if not fits:
        wanted = f"a list of {shape[-1]}, one per channel"
        if len(shape) > 1:
            wanted = f"an array that can be broadcast to {shape}"
        shown = repr(value) if array.ndim < 2 else f"of shape {array.shape}"
        raise ReadoutError(f"{owner}: {name} is {shown}; give a number, or {wanted}")
    return np.broadcast_to(array, shape).copy()
