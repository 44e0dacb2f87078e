"""Drawings show every item."""

from __future__ import annotations

from pathlib import Path

import pytest

from capsense.design import available_designs, load_design
from capsense.plotting.designs import draw_design

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("name", available_designs())
def test_drawing_names_every_electrode(name: str, tmp_path: Path) -> None:
    """A drawing can be saved and holds each electrode's name within the view."""
    design = load_design(name)
    ax = draw_design(design)
    texts = {t.get_text() for t in ax.texts}
    assert set(design.electrode_names) <= texts
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    for electrode in design.electrodes:
        low, high = electrode.surface.bounds * 1e3
        assert x0 < low[0] < high[0] < x1
        assert y0 < low[1] < high[1] < y1
    path = tmp_path / "drawing.png"
    ax.figure.savefig(path, dpi=40)
    assert path.stat().st_size > 2000


def test_draws_into_given_axes() -> None:
    """With axes given, only the top view is drawn, into them."""
    from matplotlib.figure import Figure

    figure = Figure()
    ax = figure.subplots()
    assert draw_design(load_design("six_patch"), ax) is ax
    assert figure.axes == [ax]
