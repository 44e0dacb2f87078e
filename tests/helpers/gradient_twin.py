"""The Jacobian of the surface step, slowly: energies of frozen charges at moved points."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from surface_twin import WALL_PENALTY, off_walls

from capsense.field.green_kernels import Green
from capsense.solver.system.step import Solution
from capsense.solver.tree.mean_kernels import FAR

Array = np.ndarray
STEP = 1e-5


def jacobian(solution: Solution, bodies: Array, green: Green) -> Array:
    """Central differences of the energy of frozen charges, shape (b, m, m, 6).

    Args:
        solution: Result of the step.
        bodies: Records of the bodies, which turn about their positions, shape (b,).
        green: The Green's function.
    """
    origins, free = bodies["position"], bodies["free"][solution.owner] != 0
    out = np.empty((len(origins), green.terminals, green.terminals, 6))
    for b, origin in enumerate(origins):
        own = solution.owner == b
        for r in range(6):
            energies = []
            for step in (STEP, -STEP):
                points, vector = solution.points.copy(), np.zeros(3)
                vector[r % 3] = step
                if r < 3:
                    points[own] += vector
                else:
                    points[own] = (
                        Rotation.from_rotvec(vector)
                        .apply((points[own] - origin).reshape(-1, 3))
                        .reshape(-1, 4, 3)
                        + origin
                    )
                energies.append(_energy(points, free, solution, green))
            out[b, :, :, r] = (energies[0] - energies[1]) / (2 * STEP)
    return out


def _energy(points: Array, free: Array, solution: Solution, green: Green) -> Array:
    """``Φᵀq + qᵀΦ - qᵀAq`` but for what does not change as rigid bodies move, shape (m, m)."""
    charge = solution.charge[:, : green.terminals]
    off = [
        off_walls(p.mean(axis=0), green.active_bounds, f) for p, f in zip(points, free, strict=True)
    ]
    out, held = _smooth(np.array(off).T)
    rows = _rows(points, solution.points, green) * (1 - out)[:, None]
    phi, psi = rows[:, : green.terminals], rows[:, green.phi_columns :]
    modes = psi.T @ charge
    image = points * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * green.floor]
    still = solution.points * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * green.floor]
    pairs = -_means(
        points, image, _far(solution.points, still, solution.extent), solution.softening_length
    )
    other = solution.owner[:, None] != solution.owner
    far = _far(solution.points, solution.points, solution.extent)
    pairs += np.where(other, _means(points, points, far, solution.softening_length), 0.0)
    soft = np.minimum(out**2 / np.maximum(1 - out, 1e-9), 1e4) / solution.extent
    pairs += np.diag(WALL_PENALTY * held**3 + np.where(held < out, soft, 0.0))
    return phi.T @ charge + charge.T @ phi - charge.T @ pairs @ charge + modes.T @ modes


def _smooth(x: Array) -> Array:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def _rows(points: Array, still: Array, green: Green) -> Array:
    """Means of φ⁰ and ψ over the leaves; levels give way to each other as they did."""
    centre = still.mean(axis=1)
    off = np.linalg.norm(
        np.maximum(0, np.maximum(green.box[0] - centre, centre - green.box[1])), axis=1
    )
    rows = np.zeros((len(points), green.levels[0].table.shape[1]))
    share = [np.zeros(len(points))]
    for start, end in green.blends:
        x = np.clip((end - off) / (end - start), 0.0, 1.0)
        share.append(x * x * (3 - 2 * x))
    share.append(np.ones(len(points)))
    for level, part in zip(green.levels, np.diff(share, axis=0), strict=True):
        found = _potentials(points, level.sources, green.floor, level.least) @ level.table
        rows[:, : found.shape[1]] += part[:, None] * found
    return rows


def _potentials(points: Array, sources: Array, floor: float, least: float) -> Array:
    s = sources.T.astype(float)
    mirrored = s * [1, 1, -1] + [0, 0, 2 * floor]
    direct = 1 / np.maximum(np.linalg.norm(points[:, :, None] - s, axis=-1), least)
    return (direct - 1 / np.linalg.norm(points[:, :, None] - mirrored, axis=-1)).mean(axis=1)


def _far(points: Array, others: Array, extent: Array) -> Array:
    between = np.linalg.norm(points.mean(axis=1)[:, None] - others.mean(axis=1), axis=-1)
    return between > FAR * (extent[:, None] + extent)


def _means(points: Array, others: Array, far: Array, soft: Array) -> Array:
    """Means of 1/r, by moments where clusters are far apart, else with a bounded 1/r."""
    d = points.mean(axis=1)[:, None] - others.mean(axis=1)
    r = np.linalg.norm(d, axis=-1)
    r[r == 0] = 1.0
    second = np.zeros(r.shape)
    for corner in (1, 2):
        for side, arm in (
            (points, 0.5 * (points[:, 0] - points[:, corner])[:, None]),
            (others, 0.5 * (others[:, 0] - others[:, corner])[None]),
        ):
            assert side.shape[1:] == (4, 3)
            second += 3 * (arm * d).sum(-1) ** 2 / r**2 - (arm**2).sum(-1)
    moments = 1 / r + second / (2 * r**3)
    s = ((points[:, None, :, None] - others[None, :, None]) ** 2).sum(-1)
    bound = np.maximum(soft[:, None], soft) ** 4
    return np.where(far, moments, ((s**2 + bound[..., None, None]) ** -0.25).mean((-2, -1)))
