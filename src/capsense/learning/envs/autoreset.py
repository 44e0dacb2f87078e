"""What vectorised environments share: seeds, masks, and how episodes begin again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from capsense._validate import as_whole
from capsense.errors import SceneError

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


def autoreset_of(mode: AutoresetMode | str) -> AutoresetMode:
    """The mode, which may be told by its name, as Gymnasium spells it.

    Raises:
        ValueError: There is no such mode, or environments do not begin again by themselves in it.
    """
    for known in MODES:
        if mode in (known, known.value):
            return known
    raise ValueError(
        f"autoreset_mode is {mode!r}; choose {' or '.join(repr(m.value) for m in MODES)}"
    )


def seeds_of(
    seed: int | Sequence[int | None] | None, options: dict[str, Any] | None, count: int
) -> tuple[list[int | None], NDArray[np.bool_]]:
    """A seed for each environment, and which of them begin.

    Raises:
        SceneError: Another number of seeds, or a mask of another shape.
    """
    seeds: list[int | None] = [None] * count
    if (first := as_whole(seed)) is not None:
        seeds = [first + k for k in range(count)]
    elif seed is not None:
        seeds = list(cast("Sequence[int | None]", seed))
    mask = np.asarray((options or {}).get("reset_mask", np.ones(count, np.bool_)))
    if len(seeds) != count or mask.shape != (count,) or mask.dtype != np.bool_:
        raise SceneError(f"reset: give {count} seeds, and a mask of {count} booleans")
    return seeds, mask


def ended(
    over: NDArray[np.bool_], observation: NDArray[np.float32], facts: dict[str, Any]
) -> dict[str, Any]:
    """What Gymnasium adds to the facts where episodes ended and others began in the same step.

    Args:
        over: Whose episodes ended, shape (n,).
        observation: The last observations of those episodes, shape (n, size).
        facts: Their last facts.
    """
    last = np.array([None] * len(over), dtype=object)
    for k in np.flatnonzero(over).tolist():
        last[k] = observation[k].copy()
    return {"final_obs": last, "_final_obs": over.copy(), "final_info": facts,
            "_final_info": over.copy()}  # fmt: skip
