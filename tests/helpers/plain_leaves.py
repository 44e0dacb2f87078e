"""Leaves without a table of means."""

from __future__ import annotations

from typing import Any

import numpy as np

from capsense.solver.placement.placement_kernels import ActiveClusters


def plain_leaves(*fields: Any) -> ActiveClusters:
    """Leaves from their fields ``points`` to ``within``."""
    count = len(fields[0])
    offset, barrier = np.zeros((count, 3)), np.zeros(count)
    return ActiveClusters(*fields, np.full((count, 2), -1), np.ones(count), offset, barrier)
