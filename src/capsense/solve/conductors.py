"""Which bodies of a scene conduct, and what ties them to ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.scene import Scene
from capsense.solve.finding_kernels import UNIT

Array = NDArray[np.float64]


class Conductors:
    """Which bodies conduct, and what ties them to ground."""

    def __init__(self, scene: Scene, frequency: float) -> None:
        self.index = np.full(len(scene), -1, dtype=np.int64)
        self.eps_r = np.ones(len(scene))
        ties: list[float] = []
        for i, body in enumerate(scene):
            if body.material.is_conductor(frequency):
                self.index[i] = len(ties)
                known = {"grounded": np.inf, "floating": 0.0}
                ties.append(known[body.grounding] if isinstance(body.grounding, str)
                            else float(body.grounding))  # fmt: skip
            else:
                self.eps_r[i] = body.material.at(frequency).eps_r
        self._ties = np.array(ties)
        self.parent = np.arange(max(1, len(ties)))

    def _root(self, c: int) -> int:
        while self.parent[c] != c:
            c = int(self.parent[c])
        return c

    def lanes(self, n_terminals: int) -> tuple[NDArray[np.int64], Array]:
        """Lane of each conductor (−1: at ground) and capacitance to ground of each lane [F]."""
        if np.isinf(self._ties).all():
            return np.full(max(1, len(self._ties)), -1, dtype=np.int64), np.zeros(0)
        roots = [self._root(c) for c in range(len(self._ties))]
        total = np.zeros(len(self._ties))
        for c, root in enumerate(roots):
            total[root] += self._ties[c]
        floating = sorted({r for r in roots if np.isfinite(total[r])})
        lanes = np.full(max(1, len(roots)), -1, dtype=np.int64)
        for c, root in enumerate(roots):
            if root in floating:
                lanes[c] = n_terminals + floating.index(root)
        return lanes, total[floating] if floating else np.zeros(0)

    def add_couplings(
        self, energy: Array, couples: NDArray[np.void], lanes: NDArray[np.int64]
    ) -> None:
        """Add links that run from one conductor straight to another."""
        for first, second, weight in couples.tolist():
            a, b = lanes[first], lanes[second]
            if a == b:
                continue
            w = weight * UNIT
            for lane in (a, b):
                if lane >= 0:
                    energy[lane, lane] += w
            if a >= 0 and b >= 0:
                energy[a, b] -= w
                energy[b, a] -= w
