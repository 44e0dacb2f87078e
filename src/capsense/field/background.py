"""The empty-domain field of a design, ready for the online solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.boundary import Accuracy, BoundarySolution, terminals
from capsense.field.green import GreenFunction, build_green
from capsense.mesh.lattice import MeshSettings

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

NUMERICS = 10
"""Raise it when the same design and settings give other fields than before: it is part of the cache
key, and fields of the old numerics are then no longer used."""


@dataclass(frozen=True)
class BuildSettings:
    """How finely a sensor is resolved. The background field depends on ``panel_scale`` only."""

    panel_scale: float = 1.0
    """Panel sizes of the boundary elements, as multiples of the default."""
    mesh: MeshSettings = field(default_factory=MeshSettings)
    """Mesh of the method ``"fem_masked"``, which the field does not depend on."""

    def refined(self, factor: float) -> BuildSettings:
        """Return settings with panels and mesh finer by a factor along each axis."""
        return BuildSettings(self.panel_scale / factor, self.mesh.refined(factor))


@dataclass(frozen=True, eq=False)
class BackgroundField:
    """Field and capacitances of a design without any object in its domain."""

    capacitance: Array
    """Maxwell matrix [F] of all terminals, shape (terminals, terminals)."""
    terminals: tuple[str, ...]
    """Names: electrodes in matrix order, then shields, then floating conductors."""
    n_panels: int
    """Size of the boundary-element system."""
    green: GreenFunction
    """Answer of the grounded design to charges anywhere, and the terminals' potentials."""


_STAGES = {
    "boundary elements: factorising": 0.2,
    "response to charges: where": 0.3,
    "response to charges: boundary elements": 0.4,
    "response to charges: fit": 0.9,
}
"""Share of a build's time that is over when a stage begins; 0 for the others."""


def build_background(
    design: Design,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
) -> BackgroundField:
    """Solve the empty domain of a design by boundary elements and fit its Green's function.

    ``progress`` is called with a stage's name and the fraction done, which never falls.

    Raises:
        FieldError: The geometry needs more panels than fit, or a result is not finite.
    """
    settings = settings or BuildSettings()
    tell = (lambda stage, fraction: None) if progress is None else progress

    def begin(stage: str) -> None:
        tell(stage, _STAGES.get(stage, 0.0))

    names = tuple(terminals(design))
    solution = BoundarySolution(design, Accuracy(settings.panel_scale), begin)
    densities = solution.densities(np.eye(len(names)))
    capacitance = solution.terminal_charges(densities)
    capacitance = 0.5 * (capacitance + capacitance.T)
    if not (np.isfinite(densities).all() and np.isfinite(capacitance).all()):
        raise FieldError(f"the background field of design {design.name!r} is not finite")
    green = build_green(solution, densities, begin)
    tell("done", 1.0)
    return BackgroundField(capacitance, names, len(densities), green)
