"""The layout of a board, which makes designs of itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from capsense.layout.convert import BoardDesign, convert
from capsense.layout.model import BoardData


class BoardLayout(BoardData):
    """A board as a file describes it; :meth:`assign` makes a design of some of its nets."""

    def assign(
        self,
        electrodes: Sequence[str],
        *,
        shield: Sequence[str] = (),
        ground: Sequence[str] = (),
        floating: Sequence[str] = (),
        **options: Any,
    ) -> BoardDesign:
        """Make a design of some nets; the others are left out.

        Args:
            electrodes: Names or patterns of the nets that are electrodes, in matrix order.
            shield: Those that are driven with the transmitter.
            ground: Those at ground.
            floating: Those that are connected to nothing.
            options: As :func:`capsense.layout.convert.convert` takes them.

        Raises:
            LayoutError: A pattern matches no net, a net has two roles, or two nets touch.
            DesignError: What comes out is no design that can be built.
        """
        return convert(
            self, electrodes, {"shield": shield, "ground": ground, "floating": floating}, **options
        )
