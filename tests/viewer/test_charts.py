"""Charts' data, and the heat map."""

from __future__ import annotations

import re

import numpy as np
import pytest

from capsense.reading import Touch
from capsense.viewer.charts import (
    MAX_NUMBERS,
    MAX_POINTS,
    WINDOW,
    heat_map,
    strip,
    touch_table,
)


def test_strip_is_the_end_of_a_history() -> None:
    """No more than the window and no more points than fit; the last one always."""
    times = np.arange(0.0, 40.0, 0.01)
    changes = np.stack([times, -times], axis=1)
    t, c = strip(times, changes)
    assert t[-1] == times[-1]
    assert times[-1] - WINDOW <= t[0] <= times[-1] - WINDOW + 0.1
    assert MAX_POINTS / 2 < len(t) <= MAX_POINTS
    np.testing.assert_array_equal(c, np.stack([t, -t], axis=1))
    assert len(set(np.round(np.diff(t), 9))) == 1


@pytest.mark.parametrize("count", [1, 2, 3])
def test_strip_of_a_few(count: int) -> None:
    """All of them; a single one twice, since a chart needs two points apart."""
    times, changes = np.arange(1.0, 1.0 + count), np.arange(count)[:, None]
    t, c = strip(times, changes)
    assert len(t) == len(c) == max(count, 2)
    assert (np.diff(t) > 0).all()
    np.testing.assert_array_equal(c[:count, 0], np.arange(count))


def cells(page: str) -> list[tuple[str, float, str]]:
    """Colour, its strength, and text of every cell."""
    found = re.findall(r"rgba\((\d+,\d+,\d+),([\d.]+)\)[^>]*>([^<]*)</td>", page)
    return [(colour, float(strength), text) for colour, strength, text in found]


def test_heat_map() -> None:
    """Numbers in femtofarads; colours by sign and size."""
    delta = np.array([[4e-15, -1e-15], [-1e-15, 0.0]])
    found = cells(heat_map(("A", "B"), delta))
    assert [text for *_, text in found] == ["4", "-1", "-1", "0"]
    assert [strength for _, strength, _ in found] == [1.0, 0.5, 0.5, 0.0]
    assert found[0][0] != found[1][0]


def test_heat_map_of_names_that_are_markup() -> None:
    """Names cannot change the page."""
    page = heat_map(("<b>", "B"), np.zeros((2, 2)))
    assert "<b>" not in page
    assert "&lt;b&gt;" in page


def test_heat_map_of_many() -> None:
    """More electrodes than fit show colours alone."""
    n = MAX_NUMBERS + 1
    found = cells(heat_map([f"E{k}" for k in range(n)], np.eye(n)))
    assert len(found) == n * n
    assert {text for *_, text in found} == {"&nbsp;"}


def test_touch_is_a_row_for_each_electrode() -> None:
    touch = Touch(np.array([0.512, 0.0]), np.array([1e-3, 0.0]), 0.5)
    page = touch_table(["A<", "B"], touch, 2e-3)
    assert "A&lt;" in page
    assert re.findall(r"<td>([^<]*) N</td>", page) == ["0.512", "0"]
    assert re.findall(r">([^<]*) mm</td>", page) == ["1.00", "0.00"]
    assert re.findall(r"width:([\d.]+)%\">", page)[-2:] == ["50.0", "0.0"]
    assert "0.5 N in total" in page
