"""How pictures look: colours, lines and axes, the same in all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#7A5C00", "#333333")
"""After Okabe and Ito: told apart with any colour vision; yellow darkened for white paper."""
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))
INK, FAINT = "#2b2b2b", "#b9bdc1"
"""Of text and outlines, and of what stands back."""
QUIET, LOUD = (214, 219, 222), (213, 94, 0)
"""Red, green and blue of an electrode without a signal, and with the largest one."""
TIME_COLOURS = "cividis"
"""The colour map of time: even in lightness, and the same to any colour vision."""
LABELS: dict[str, Any] = {"fontsize": 9, "color": INK}
TITLES: dict[str, Any] = {"fontsize": 10, "fontweight": "bold", "color": INK, "loc": "left"}
LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}


def style_of(number: int) -> tuple[str, Any]:
    """Colour and dashes of signal ``number``."""
    return COLOURS[number % len(COLOURS)], DASHES[(number // len(COLOURS)) % len(DASHES)]


def signal_colours(strength: ArrayLike) -> NDArray[np.float64]:
    """Red, green and blue, 0 to 255, of electrodes with signals from 0 to 1, shape (M, 3)."""
    part = np.clip(np.asarray(strength, dtype=float), 0.0, 1.0)[:, None]
    return np.array(QUIET) + part * np.subtract(LOUD, QUIET)


def strength(changes: ArrayLike) -> NDArray[np.float64]:
    """How strongly electrodes light up, 0 to 1: the logarithm of 1 + change / 0.1 fF, 1 at 1 pF."""
    return np.clip(np.log10(1.0 + np.abs(changes) / 1e-16) / 4.0, 0.0, 1.0)


def bare(axes: Axes) -> None:
    """Take everything off the axes that shows no data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.grid(color="#e6e8ea", lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, colors=INK, length=3, color=FAINT)


def dress(axes: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Name the axes and what they show, each where it is given; the rest as :func:`bare`."""
    if x:
        axes.set_xlabel(x, **LABELS)
    if y:
        axes.set_ylabel(y, **LABELS)
    if title:
        axes.set_title(title, **TITLES)
    bare(axes)


def unit_of(largest: float) -> tuple[float, str]:
    """A factor and a unit in which ``largest`` [F] is a handy number."""
    for factor, unit in ((1e12, "pF"), (1e15, "fF")):
        if largest * factor >= 1.0:
            return factor, unit
    return 1e18, "aF"
