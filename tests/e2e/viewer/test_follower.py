"""The follower: live samples are kept, held, and looked at again."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from view_sources import Queued, until

from capsense.errors import ProtocolError
from capsense.viewer import player as players
from capsense.viewer.player import Follower


@pytest.fixture
def followed(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Queued, Follower]]:
    monkeypatch.setattr(players, "KEPT", 10)
    stream = Queued()
    player = Follower(stream)  # type: ignore[arg-type]
    player.plane = object()
    yield stream, player
    player.stop()
    assert stream.closed
    assert not any(t.name == "capsense follower" for t in threading.enumerate())


def test_follows(followed: tuple[Queued, Follower]) -> None:
    """The newest is shown, and the ones before make charts."""
    stream, player = followed
    assert (player.newest, player.span, player.playing) == (None, (0, 0), True)
    stream.put(6)
    until(lambda: player.span == (0, 5))
    assert player.newest.index == 5
    times, changes = player.history(5)
    np.testing.assert_allclose(times, 0.1 * np.arange(6))
    np.testing.assert_array_equal(changes[:, -1], np.arange(1.0, 7.0))


def test_holds_and_looks_back(followed: tuple[Queued, Follower]) -> None:
    """While it is held, samples come in unseen; steps go through what is kept."""
    stream, player = followed
    stream.put(4)
    until(lambda: player.span == (0, 3))
    player.pause()
    stream.put(3)
    until(lambda: player.span == (0, 6))
    assert (player.newest.index, player.playing) == (3, False)
    player.step(-2)
    assert player.newest.index == 1
    until(lambda: player.with_field.index == 1)
    assert player.with_field.plane is player.plane
    player.plane = object()  # moved while the sample is held
    until(lambda: player.with_field.plane is player.plane)
    assert player.with_field.index == 1
    player.step(1)
    assert player.newest.index == 2
    player.go(1000)
    assert player.newest.index == 6
    player.go(-1)
    assert player.newest.index == 0
    player.play()
    assert player.newest.index == 6


def test_forgets_the_oldest(followed: tuple[Queued, Follower]) -> None:
    """At least ten of many are kept; one that is held and forgotten gives way to the oldest."""
    stream, player = followed
    stream.put(20)
    until(lambda: player.span == (0, 19))
    player.go(2)
    stream.put(5)
    until(lambda: player.span == (10, 24))
    assert player.newest.index == 10
    times, changes = player.history(12)
    np.testing.assert_allclose(times, [1.0, 1.1, 1.2])
    np.testing.assert_array_equal(changes[:, 0], [11, 12, 13])


def test_goes_on_after_a_failure(
    followed: tuple[Queued, Follower], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What went wrong is told until something comes again."""
    monkeypatch.setattr(players, "RETRY", 0.05)
    stream, player = followed
    stream.put(2)
    stream.items.put(ProtocolError("the client has left"))
    until(lambda: player.failure is not None)
    assert player.newest.index == 1
    stream.put(1)
    until(lambda: player.failure is None and player.newest.index == 2)


def test_potentials_take_half_of_the_time(
    followed: tuple[Queued, Follower], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that take long are not begun again before as long has gone by."""
    stream, _ = followed
    spans: list[tuple[float, float]] = []

    def slow(frame: object, plane: object) -> np.ndarray:
        begun = time.monotonic()
        time.sleep(0.15)
        spans.append((begun, time.monotonic()))
        return np.zeros((3, 2))

    monkeypatch.setattr(stream, "potentials", slow)

    def fed() -> bool:
        stream.put(1)
        return len(spans) >= 4

    until(fed)
    pauses = [after[0] - before[1] for before, after in pairwise(spans)]
    assert min(pauses) > 0.14
