"""Spacings of the mesh that the masked scheme solves on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshSettings:
    """Spacings of the planes whose cells are split into tetrahedra; all lengths in metres."""

    edge: float = 0.0036
    """Largest spacing beside an electrode's edge, in the plane."""
    growth: float = 0.53
    """Growth of the in-plane spacing per unit distance from the nearest edge."""
    far: float = 0.06
    """Largest in-plane spacing."""
    face: float = 0.0024
    """Spacing beside an electrode's face, across the plane."""
    growth_z: float = 0.207
    """Growth of the spacing across the plane per unit distance from the nearest face."""
    far_z: float = 0.013
    """Largest spacing across the plane …"""
    tall: float = 0.074
    """… or, where that is more, this fraction of the distance from the nearest face."""
    merge: float = 0.0008
    """Edges closer to each other than this share one plane."""

    def refined(self, factor: float) -> MeshSettings:
        """Return settings with ``factor`` times as many nodes along each axis."""
        return MeshSettings(
            self.edge / factor, self.growth / factor, self.far / factor, self.face / factor,
            self.growth_z / factor, self.far_z / factor, self.tall / factor,
            self.merge / max(1.0, factor),
        )  # fmt: skip
