"""The empty-domain field of a design, ready for the online solver."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.boundary import Accuracy, BoundarySolution, terminals
from capsense.field.calibration import calibrate, half_link_weights
from capsense.field.lattice import FREE, Cuts, Lattice, LatticeSettings, build_lattice

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

FORMAT = 1
"""Version of the stored form; part of the cache key."""


@dataclass(frozen=True)
class BuildSettings:
    """Everything numerical that a background field depends on."""

    lattice: LatticeSettings = LatticeSettings()
    panel_scale: float = 1.0
    """Panel sizes of the boundary elements, as multiples of the default."""
    calibration: float = 0.3
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


def build_background(
    design: Design, settings: BuildSettings | None = None, progress: Progress | None = None
) -> BackgroundField:
    """Solve the empty domain of a design and carry the fields to the online lattice.

    ``progress`` is called with a stage's name and the fraction done.

    Raises:
        FieldError: The geometry needs more panels than fit, or a result is not finite.
    """
    settings = settings or BuildSettings()
    tell = progress or (lambda stage, fraction: None)
    names = tuple(terminals(design))
    tell("lattice", 0.0)
    lattice = build_lattice(design, settings.lattice)
    solution = BoundarySolution(
        design, Accuracy(settings.panel_scale), lambda text: tell(text, 0.05)
    )
    densities = solution.densities(np.eye(len(names)))
    capacitance = solution.terminal_charges(densities)
    capacitance = 0.5 * (capacitance + capacitance.T)
    potentials = node_potentials(lattice, solution, densities, tell)
    if not (np.isfinite(potentials).all() and np.isfinite(capacitance).all()):
        raise FieldError(f"the background field of design {design.name!r} is not finite")
    tell("calibration", 0.9)
    weights, half = lattice.weights, half_link_weights(lattice)
    if np.isfinite(settings.calibration):
        weights, half = calibrate(lattice, potentials, settings.calibration)
    lattice = Lattice(
        lattice.axes, weights, lattice.eps_r, lattice.owner, lattice.kink, lattice.cuts
    )
    tell("done", 1.0)
    return BackgroundField(
        lattice, half, potentials, capacitance, names, len(solution.model.panels)
    )


def node_potentials(
    lattice: Lattice, solution: BoundarySolution, densities: Array, tell: Progress
) -> Array:
    """Evaluate the terminals' fields at all nodes; held nodes get their exact potential."""
    potentials = np.zeros((lattice.n_nodes, densities.shape[1]))
    points = lattice.points
    free = np.flatnonzero(lattice.owner == FREE)
    for part in np.array_split(free, max(1, len(free) // 4000)):
        potentials[part] = solution.potential(points[part], densities)
        tell("field at the nodes", 0.1 + 0.8 * (part[-1] + 1) / lattice.n_nodes)
    driven = np.flatnonzero(lattice.owner >= 0)
    potentials[driven, lattice.owner[driven]] = 1.0
    return np.clip(potentials, 0.0, 1.0)


def save_background(field: BackgroundField, path: Path) -> None:
    """Write a field to an .npz file (single precision, compressed)."""
    la = field.lattice
    meta = {"format": FORMAT, "terminals": field.terminals, "n_panels": field.n_panels}
    arrays = {
        "meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8),
        "x": la.axes[0], "y": la.axes[1], "z": la.axes[2],
        "weights": la.weights.astype(np.float32), "eps_r": la.eps_r.astype(np.float32),
        "owner": la.owner.astype(np.int16), "kink": la.kink,
        "half_weights": field.half_weights, "capacitance": field.capacitance,
        "potentials": field.potentials.astype(np.float32),
        "cut_axis": la.cuts.axis, "cut_node": la.cuts.node,
        "cut_lower": la.cuts.lower, "cut_lower_owner": la.cuts.lower_owner,
        "cut_upper": la.cuts.upper, "cut_upper_owner": la.cuts.upper_owner,
    }  # fmt: skip
    with open(path, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def load_background(path: Path) -> BackgroundField:
    """Read a field written by :func:`save_background`.

    Raises:
        FieldError: The file is damaged or of another format version.
    """
    try:
        with np.load(path) as data:
            meta = json.loads(data["meta"].tobytes())
            if meta["format"] != FORMAT:
                raise FieldError(f"{path} has format {meta['format']}, this version reads {FORMAT}")
            cuts = Cuts(
                data["cut_axis"], data["cut_node"], data["cut_lower"], data["cut_lower_owner"],
                data["cut_upper"], data["cut_upper_owner"],
            )  # fmt: skip
            lattice = Lattice(
                (data["x"], data["y"], data["z"]),
                data["weights"].astype(float), data["eps_r"].astype(float),
                data["owner"].astype(np.int64), data["kink"], cuts,
            )  # fmt: skip
            return BackgroundField(
                lattice, data["half_weights"], data["potentials"].astype(float),
                data["capacitance"], tuple(meta["terminals"]), int(meta["n_panels"]),
            )  # fmt: skip
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise FieldError(f"{path} is not a readable background field: {error}") from error
