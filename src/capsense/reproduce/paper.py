"""Tables of Schöffmann et al. 2022, as numbers."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def correlations(table: int) -> dict[str, Any]:
    """Eq. 12 of the paper's simulation against its hardware.

    Args:
        table: 1, by speed [m/s, as text] and board; or 2, a list over electrodes by participant.
    """
    path = files("capsense.reproduce") / "data" / f"table_{table}.json"
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))["normalised cross-correlation"]
    return found
