"""Damaged files: seeded mutations of sound ones, of text and of bytes."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator

_NUMBERS = (0, 1, -1, 2**31 - 1, 2**32 - 1, 2**63 - 1, -(2**31))
_WORDS = (
    b"nan",
    b"1e999",
    b"-1",
    b"0",
    b"",
    b"\xff\xfe",
    b"'",
    b"[",
    b"99999999999999999999",
    b"null",
)


def mutations(content: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """``count`` damaged forms of a file: bits, bytes, numbers and words changed, parts moved."""
    chance = random.Random(seed)
    for _ in range(count):
        out = bytearray(content)
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            _mutate(out, chance)
        yield bytes(out)


def _mutate(out: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(out) + 1)
    size = min(len(out) - at, chance.choice((1, 2, 4, 8, 30, 200)))
    kind = chance.randrange(7)
    if kind == 0 and size:
        out[at] ^= 1 << chance.randrange(8)
    elif kind == 1:
        del out[at:]
    elif kind == 2:
        del out[at : at + size]
    elif kind == 3:
        out[at : at + size] = chance.randbytes(size)
    elif kind == 4:
        out[at:at] = out[at : at + size] * chance.choice((1, 2, 100))
    elif kind == 5:
        code = chance.choice(("<q", "<i", ">i", "<d", "<f"))
        number = chance.choice(_NUMBERS if code == "<q" else _NUMBERS[:4])
        packed = struct.pack(code, number)
        out[at : at + len(packed)] = packed
    else:
        _word(out, at, chance)


def _word(out: bytearray, at: int, chance: random.Random) -> None:
    """Replace the word at a place."""
    space = b" \n\t,;<>=\"'[]{}"
    first = last = at
    while first > 0 and out[first - 1] not in space and at - first < 40:
        first -= 1
    while last < len(out) and out[last] not in space and last - at < 40:
        last += 1
    out[first:last] = chance.choice(_WORDS)
