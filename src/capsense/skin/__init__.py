"""Skins: many sensors read in one call, and layouts of electrodes on the links of robots.

:class:`Skin` reads sensors. :func:`from_mesh`, :func:`from_taxels` and :func:`paint` make a
:class:`SkinLayout`: the patches of a link, which ``cs.Skin`` and the adapters take.
"""

from __future__ import annotations

from capsense.skin.layout import Pad, SkinLayout
from capsense.skin.make import from_mesh, from_taxels, paint
from capsense.skin.reader import (
    AnyDesign,
    Skin,
    make_simulators,
    read_all,
    reset_all,
    use_readouts,
)

__all__ = [
    "AnyDesign", "Pad", "Skin", "SkinLayout", "from_mesh", "from_taxels", "make_simulators",
    "paint", "read_all", "reset_all", "use_readouts",
]  # fmt: skip
