"""The empty-domain field of a design, ready for the online solver."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.boundary import (
    Accuracy,
    BoundaryModel,
    BoundarySolution,
    build_model,
    terminals,
)
from capsense.field.calibration import calibrate, half_link_weights
from capsense.field.green import GreenFunction, build_green, from_arrays, to_arrays
from capsense.field.lattice import Lattice, LatticeSettings, build_lattice

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

NUMERICS = 6
"""Raise it when the same design and settings give other fields than before: it is part of the cache
key, and fields of the old numerics are then no longer used."""

_PART = 256
"""Nodes evaluated at a time, between two chances to stop."""
_SAVE_EVERY = 2.0
"""Work that an interruption may cost [s]."""


@dataclass(frozen=True)
class BuildSettings:
    """Everything numerical that a background field depends on."""

    lattice: LatticeSettings = field(default_factory=LatticeSettings)
    panel_scale: float = 1.0
    """Panel sizes of the boundary elements, as multiples of the default."""
    calibration: float = 0.22
    """Strength of the pull towards geometric weights; infinity switches calibration off."""


@dataclass(frozen=True, eq=False)
class BackgroundField:
    """Fields and capacitances of a design without any object in its domain."""

    lattice: Lattice
    """The online mesh; its weights are calibrated."""
    half_weights: Array
    """Weights [F] of the half-links of ``lattice.cuts``, shape (cuts, 2)."""
    potentials: Array
    """Potential [V] at the nodes for each terminal at 1 V, others at 0, shape (n, terminals)."""
    capacitance: Array
    """Maxwell matrix [F] of all terminals, shape (terminals, terminals)."""
    terminals: tuple[str, ...]
    """Names: electrodes in matrix order, then shields, then floating conductors."""
    n_panels: int
    """Size of the boundary-element system."""
    green: GreenFunction
    """Answer of the grounded design to charges anywhere, and the terminals' potentials."""


class Checkpoint(Protocol):
    """Where a build leaves the results of finished stages, and finds those of an earlier one."""

    def load(self, stage: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a finished stage, or None."""

    def save(self, stage: str, **arrays: NDArray[Any]) -> None:
        """Keep the arrays of a finished stage."""


class NoCheckpoint:
    """Keeps nothing."""

    def load(self, stage: str) -> dict[str, NDArray[Any]] | None:
        """Return None."""
        return None

    def save(self, stage: str, **arrays: NDArray[Any]) -> None:
        """Do nothing."""


def build_background(
    design: Design,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> BackgroundField:
    """Solve the empty domain of a design and carry the fields to the online lattice.

    ``progress`` is called with a stage's name and the fraction done, which never falls. Stages
    found in ``checkpoint`` are not computed again; the result is the same to the last bit.

    Raises:
        FieldError: The geometry needs more panels than fit, or a result is not finite.
    """
    settings = settings or BuildSettings()
    kept = NoCheckpoint() if checkpoint is None else checkpoint
    tell = (lambda stage, fraction: None) if progress is None else progress
    tell("lattice", 0.0)
    lattice = build_lattice(design, settings.lattice)
    charges = _solve_charges(design, settings, kept, tell)
    potentials = _node_potentials(lattice, charges, kept, tell)
    tell("calibration", 0.92)
    weights, half = lattice.weights, half_link_weights(lattice)
    if math.isfinite(settings.calibration):
        weights, half = calibrate(lattice, potentials, charges.capacitance, settings.calibration)
    _require_finite(design, potentials, charges.capacitance, weights, half)
    tell("done", 1.0)
    return BackgroundField(
        replace(lattice, weights=weights), half, potentials, charges.capacitance,
        tuple(terminals(design)), len(charges.densities), charges.green,
    )  # fmt: skip


# -- stages -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Charges:
    """The solved boundary elements: all that the field at any point follows from."""

    evaluator: _Evaluator
    densities: Array
    """Charge densities [C/m²] on the panels, a column for each terminal, (panels, terminals)."""
    capacitance: Array
    """Maxwell matrix [F] of the terminals."""
    green: GreenFunction


class _Evaluator(BoundarySolution):
    """Evaluates the potential of known densities; its system of equations is never set up."""

    def __init__(self, design: Design, model: BoundaryModel) -> None:
        self.design = design
        self.model = model


def _solve_charges(
    design: Design, settings: BuildSettings, kept: Checkpoint, tell: Progress
) -> _Charges:
    """Solve the boundary elements with each terminal at 1 V in turn."""
    accuracy = Accuracy(settings.panel_scale)
    n = len(terminals(design))
    found = kept.load("charges")
    if found is not None:
        model = build_model(design, accuracy)
        densities, capacitance = found.pop("densities"), found.pop("capacitance")
        if densities.shape == (len(model.panels), n) and capacitance.shape == (n, n):
            return _Charges(_Evaluator(design, model), densities, capacitance, from_arrays(found))
    fractions = iter((0.02, 0.06))  # at the start of the matrix and of its factorisation
    solution = BoundarySolution(design, accuracy, lambda text: tell(text, next(fractions, 0.06)))
    densities = solution.densities(np.eye(n))
    capacitance = solution.terminal_charges(densities)
    capacitance = 0.5 * (capacitance + capacitance.T)
    _require_finite(design, densities, capacitance)
    green = build_green(solution, densities, lambda text: tell(text, 0.12))
    kept.save("charges", densities=densities, capacitance=capacitance, **to_arrays(green))
    # the factorised matrix is large, and no longer needed
    return _Charges(_Evaluator(design, solution.model), densities, capacitance, green)


def _node_potentials(
    lattice: Lattice, charges: _Charges, kept: Checkpoint, tell: Progress
) -> Array:
    """Evaluate the terminals' fields at all nodes; held nodes get their exact potential."""
    n_terminals = charges.densities.shape[1]
    free = np.flatnonzero(lattice.unknown)
    points = lattice.points[free]
    values = np.empty((len(free), n_terminals))
    done = 0
    while done < len(free) and (found := kept.load(f"potentials-{done}")) is not None:
        rows = found["values"]
        whole = len(rows) % _PART == 0 or done + len(rows) == len(free)
        if not len(rows) or not whole or rows.shape != values[done : done + len(rows)].shape:
            break
        values[done : done + len(rows)] = rows
        done += len(rows)
    saved, since = done, time.monotonic()
    for start in range(done, len(free), _PART):
        tell("field at the nodes", 0.2 + 0.72 * start / len(free))
        done = min(start + _PART, len(free))
        values[start:done] = charges.evaluator.potential(points[start:done], charges.densities)
        if time.monotonic() - since > _SAVE_EVERY:
            kept.save(f"potentials-{saved}", values=values[saved:done])
            saved, since = done, time.monotonic()
    if saved < done:
        kept.save(f"potentials-{saved}", values=values[saved:done])
    potentials = np.zeros((lattice.n_nodes, n_terminals))
    potentials[free] = values
    driven = np.flatnonzero(lattice.owner >= 0)
    potentials[driven, lattice.owner[driven]] = 1.0
    potentials = potentials[lattice.home]
    return np.clip(potentials, 0.0, 1.0)


def _require_finite(design: Design, *arrays: Array) -> None:
    if not all(np.isfinite(a).all() for a in arrays):
        raise FieldError(f"the background field of design {design.name!r} is not finite")
