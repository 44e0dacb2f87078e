"""Random numbers of many chips: each is a function of a key and of a count.

So what is drawn for one chip depends neither on what others draw nor on the order, and any device
gives the same numbers. Bits are those of SplitMix64's finaliser (Steele, Lea and Flood 2014), a
normal number is made of 64 of them after Box and Muller.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.readout.checks import Array, Ints

Words = NDArray[np.uint64]

GAMMA = 0x9E3779B97F4A7C15
"""2⁶⁴ over the golden ratio."""
COLUMNS = 256
"""Random numbers that a stage has for a sample."""


def mixed(words: Words) -> Words:
    """Words of 64 bits, each made another one."""
    out = np.array(words, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        out ^= out >> np.uint64(shift)
        out *= np.uint64(factor)
    out ^= out >> np.uint64(31)
    return out


def drawn(keys: Words, count: Any) -> Words:
    """Random bits of keys, by their counts from 0 on; the two are broadcast."""
    order = (np.asarray(count).astype(np.uint64) + np.uint64(1)) * np.uint64(GAMMA)
    return mixed(keys ^ mixed(order))


def root(seed: int) -> Words:
    """The key of a seed, which is any whole number from 0 on."""
    return np.asarray(np.random.SeedSequence(seed).generate_state(1, np.uint64), np.uint64)


def uniform(words: Words) -> Array:
    """Numbers in (0, 1) of random bits, never 0 and never 1."""
    return ((words >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53


def normal(words: Words, count: int) -> Array:
    """Standard normal numbers of random bits, two a word.

    Args:
        words: Shape (m, p).
        count: How many columns, 2 p or one less.

    Returns:
        Shape (m, count).
    """
    half = 2.0**-32
    size = ((words >> np.uint64(32)).astype(float) + 0.5) * half
    size = np.sqrt(-2.0 * np.log(size))
    turn = ((words & np.uint64(0xFFFFFFFF)).astype(float) + 0.5) * (2.0 * math.pi * half)
    out = np.empty((len(words), count))
    out[:, ::2] = size * np.cos(turn)
    second = count // 2
    out[:, 1::2] = size[:, :second] * np.sin(turn[:, :second])
    return out


class Streams:
    """The random numbers of a stage of many chips, in place of a generator of one.

    Args:
        keys: One a channel, of any shape; what changes there changes here.
        scale: Factor on normal numbers, as ``keys``.
        channels: Channels of a chip.
        stages: Number of stages.
        stage: Number of this one.
    """

    def __init__(self, keys: Words, scale: Array, channels: int, stages: int, stage: int) -> None:
        self._keys, self._scale = keys, scale
        self._channels, self._stages, self._stage = channels, stages, stage
        self.at(np.arange(keys.size), np.full(keys.size, -1))

    def at(self, channel: Ints, sample: Ints) -> None:
        """Choose samples by channel and number, -1 for what is drawn at the start; shape (m,)."""
        self._channel, self._sample = channel, sample

    def _words(self, channel: Ints, sample: Ints, columns: Ints) -> Words:
        count = (sample + 1) * self._stages + self._stage
        return drawn(self._keys.reshape(-1)[channel, None], count[:, None] * COLUMNS + columns)

    def standard_normal(self, size: int | tuple[int, int]) -> Array:
        """Of the samples chosen, shape (m,) or (m, columns)."""
        columns = 1 if isinstance(size, int) else size[1]
        pairs = np.arange((columns + 1) // 2)
        found = normal(self._words(self._channel, self._sample, pairs), columns)
        found *= self._scale.reshape(-1)[self._channel, None]
        return found[:, 0] if isinstance(size, int) else found

    def random(self, size: int) -> Array:
        """One a chip, of those whose first channel is chosen, shape (size,)."""
        first = self._channel % self._channels == 0
        channel, sample = self._channel[first], self._sample[first]
        return uniform(self._words(channel, sample, np.zeros(1, np.int64)))[:, 0]
