"""Progress of long work, such as building a design's field, on a terminal."""

from __future__ import annotations

import sys
from typing import Any


class BuildProgress:
    """A progress callback for :class:`capsense.Simulator`: ``progress(stage, fraction)``.

    The bar appears at the first call, so that a field from the cache shows none.

    Args:
        shown: Whether there is a terminal to draw on.
        prefix: What stands before the stage's name.
    """

    def __init__(self, *, shown: bool, prefix: str = "building the field: ") -> None:
        self._shown = shown
        self._prefix = prefix
        self._bar: Any = None

    def __enter__(self) -> BuildProgress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, stage: str, fraction: float) -> None:
        """Show that ``stage`` is done to ``fraction``, from 0 to 1."""
        if not self._shown:
            return
        if self._bar is None:
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}"
            self._bar = tqdm(total=1.0, file=sys.stderr, bar_format=form, leave=False)
        self._bar.set_description(f"{self._prefix}{stage}", refresh=False)
        self._bar.n = min(max(fraction, 0.0), 1.0)
        self._bar.refresh()
