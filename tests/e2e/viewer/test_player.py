"""The player: play, pause, step, scrub, at a pace, through failures."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from view_sources import Counting, until

from capsense.viewer.player import Player


@contextmanager
def playing(source: Counting, **options: float) -> Iterator[Player]:
    player = Player(source, **options)
    try:
        until(lambda: player.newest is not None or player.failure is not None)
        yield player
    finally:
        player.stop()
        assert source.closed
        assert not any(t.name == "capsense player" for t in threading.enumerate())


def shows(player: Player, index: int) -> Callable[[], bool]:
    return lambda: player.newest is not None and player.newest.index == index


def test_first_sample_and_pause() -> None:
    """It stands on the first sample until it is told to play."""
    source = Counting()
    with playing(source) as player:
        assert shows(player, 0)()
        assert not player.playing
        assert player.span == (0, 19)
    assert source.asked == [(0, None)]


def test_plays_every_sample_to_the_end() -> None:
    """As fast as it goes, none is left out; the end is the end without looping."""
    source = Counting()
    with playing(source, speed=0.0) as player:
        player.loop = False
        player.play()
        until(lambda: not player.playing)
        assert shows(player, 19)()
        assert [k for k, _ in source.asked] == list(range(20))
        times, changes = player.history(19)
        np.testing.assert_array_equal(times, source.times)
        np.testing.assert_array_equal(changes, np.arange(1.0, 21.0)[:, None] * np.ones(10))
        player.play()  # from the beginning
        until(lambda: len(source.asked) == 40)
        assert [k for k, _ in source.asked[20:]] == list(range(20))


def test_loops() -> None:
    """The end is followed by the beginning."""
    source = Counting(5)
    with playing(source, speed=0.0) as player:
        player.play()
        until(lambda: len(source.asked) > 30)
        player.pause()
        order = [k for k, _ in list(source.asked)]
    assert order[:12] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]


def test_steps_and_scrubs() -> None:
    """On, back, far away, beyond both ends; each stops time."""
    with playing(Counting(), speed=0.0) as player:
        player.play()
        player.go(7)
        until(shows(player, 7))
        assert not player.playing
        player.step(1)
        player.step(1)  # before the first was taken, perhaps
        until(shows(player, 9))
        player.step(-3)
        until(shows(player, 6))
        player.go(1000)
        until(shows(player, 19))
        player.step(-1000)
        until(shows(player, 0))


def test_history_holds_what_was_stepped() -> None:
    """Samples that were skipped, or lie ahead, are not in charts."""
    with playing(Counting()) as player:
        for k in (12, 5, 9):
            player.go(k)
            until(shows(player, k))
        times, changes = player.history(9)
        np.testing.assert_allclose(times, [0.0, 0.005, 0.009])
        np.testing.assert_array_equal(changes[:, 0], [1, 6, 10])
        assert len(player.history(19)[0]) == 4


def test_pace() -> None:
    """At a tenth of the speed no sample comes before its time."""
    source = Counting(4, period=0.02)
    with playing(source, speed=0.5) as player:
        player.loop = False
        began = time.monotonic()
        player.play()
        until(shows(player, 3))
        assert time.monotonic() - began >= 0.06 / 0.5
        player.set_speed(0.0)


def test_a_failure_stops_time_and_is_told() -> None:
    """The player can go on elsewhere, and the failure is forgotten then."""
    source = Counting()
    source.broken = {3}
    with playing(source, speed=0.0) as player:
        player.play()
        until(lambda: player.failure is not None)
        assert not player.playing
        assert shows(player, 2)()
        player.step(1)
        until(shows(player, 4))
        assert player.failure is None


def test_potentials_as_wanted() -> None:
    """Taken when paused; while time runs, not of every sample; not at all where not wanted."""
    source, plane = Counting(200), object()
    with playing(source, speed=0.0) as player:
        player.loop = False
        player.plane = plane
        player.play()
        until(lambda: not player.playing)
        assert sum(asked is plane for _, asked in source.asked) < 100
        player.pause()
        until(lambda: player.with_field is not None and player.with_field.index == 199)
        assert player.with_field.plane is plane
        player.plane = None
        player.go(3)
        until(shows(player, 3))
        assert player.with_field.index == 199


@pytest.mark.parametrize("count", [1, 2])
def test_short(count: int) -> None:
    """One sample, or two, play as well."""
    source = Counting(count)
    with playing(source, speed=0.0) as player:
        player.play()
        until(lambda: len(source.asked) > 5)
        player.step(-1)
        until(lambda: not player.playing)
