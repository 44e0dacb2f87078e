"""Objects that never change, and their copies."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", bound=np.generic)


def read_only(array: NDArray[_Number]) -> NDArray[_Number]:
    """The array itself, which cannot be written to any more."""
    array.setflags(write=False)
    return array


class Frozen:
    """A frozen dataclass that is pickled and copied by its fields alone.

    What was worked out from them is left behind, and worked out again by the copy. Arrays that the
    copy holds are read-only, as those of the original are.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                read_only(value)
        self.__dict__.update(state)
