"""What the analogue stages of a readout have in common.

A stage is a small frozen description. When a readout starts it makes a *process* of it, which
holds what changes: random numbers, filters' memories. Stages are applied in their order; each takes
the capacitances of a batch of samples and returns new ones. A batch is a run of successive samples
of the schedule, of any length; a process with a memory for each channel goes through it in
:func:`rounds`. It gives the same numbers, to the last bit, however samples are dealt into batches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from capsense.readout.checks import Array, Ints


@dataclass(frozen=True, eq=False)
class Context:
    """What a stage is told when a readout starts."""

    channels: int
    """Number of channels K."""
    conversion: float
    """Length of a conversion's window [s]."""
    period: float
    """Time from one sample of a channel to its next [s]."""
    rng: np.random.Generator
    """Random numbers of this stage alone."""


class Process(Protocol):
    """A stage at work.

    A copy of a readout copies its processes: keep what changes in objects that can be copied, as
    the arguments of a ``functools.partial``, and not in the variables of an enclosing function.
    """

    def __call__(self, channel: Ints, time: Array, value: Array) -> Array:
        """Return the new capacitances of a batch [F], shape (n,).

        Args:
            channel: Channel numbers; any K in a row are all different; shape (n,).
            time: Instants [s], not falling, shape (n,).
            value: Capacitances [F], shape (n,).
        """


@runtime_checkable
class Stage(Protocol):
    """One link of the analogue chain."""

    def start(self, context: Context) -> Process:
        """Return the stage's process, in its initial state."""


def rounds(samples: int, channels: int) -> Iterator[slice]:
    """Cut a batch into parts that hold each of the channels once at most."""
    for first in range(0, samples, channels):
        yield slice(first, first + channels)
