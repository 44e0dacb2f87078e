"""Slow, readable twins of the compiled kernels of layered depth images and of the rasteriser.

They follow the rules of ``docs/depth.md`` word by word and serve as the tests' measure.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from capsense.scene.layer_build import FAR, LEAST
from capsense.scene.layers import STEP_SLOPE
from capsense.scene.raster_kernels import LEAST_COSINE

Array = NDArray[np.float64]
Stretch = tuple[float, float]


def unite(stretches: list[Stretch]) -> list[Stretch]:
    """The union of stretches, ascending and disjoint."""
    out: list[Stretch] = []
    for a, b in sorted(stretches):
        if out and a <= out[-1][1]:
            out[-1] = (out[-1][0], max(out[-1][1], b))
        else:
            out.append((a, b))
    return out


class ReferenceLayers:
    """A layered depth image that is not cropped: one ring of pixels around the whole image.

    Args:
        front, back: Shape (layers, rows, columns) [m].
        size: Width and height of the image [m].
        rows, columns: Outlines along rows and columns if they are known, as
            :meth:`~capsense.scene.layers.Layers.from_outlines` takes them.
    """

    def __init__(
        self, front: Array, back: Array, size: tuple[float, float],
        rows: Array | None = None, columns: Array | None = None,
    ) -> None:  # fmt: skip
        _, ny, nx = front.shape
        self.dx, self.dy = size[0] / nx, size[1] / ny
        self.limit = STEP_SLOPE * max(self.dx, self.dy)
        self.origin = (-0.5 * size[0] - 0.5 * self.dx, -0.5 * size[1] - 0.5 * self.dy)
        cells = [[self._sorted(front[:, j, i], back[:, j, i]) for i in range(nx)]
                 for j in range(ny)]  # fmt: skip
        slots = max(len(c) for row in cells for c in row)
        self.f, self.b, self.m = np.zeros((3, slots, ny + 2, nx + 2))
        for k in range(slots):
            hit = np.zeros((ny + 2, nx + 2), dtype=bool)
            low, high = np.zeros((2, ny + 2, nx + 2))
            for j in range(ny):
                for i in range(nx):
                    if len(cells[j][i]) > k:
                        hit[j + 1, i + 1] = True
                        low[j + 1, i + 1], high[j + 1, i + 1] = cells[j][i][k]
            along = self._distances(hit, high - low, rows)
            turned = None if columns is None else columns.transpose(1, 0, 2)
            across = self._distances(hit.T, (high - low).T, turned).T
            distance = np.minimum(np.minimum(along, across), FAR)
            self.m[k] = np.where(hit, distance, -distance)
            self.f[k], self.b[k] = self._bent(low, hit), self._bent(high, hit)
            self._carry_on(self.f[k], self.b[k], hit)

    @staticmethod
    def _sorted(front: Array, back: Array) -> list[Stretch]:
        ends = zip(front.tolist(), back.tolist(), strict=True)
        return unite([(a, b) for a, b in ends if a < b and math.isfinite(b - a)])

    def _distances(self, hit: NDArray[np.bool_], thick: Array, outlines: Array | None) -> Array:
        """Distance in pixels along its row from each pixel to the next silhouette."""
        out = np.full(hit.shape, np.inf)
        n = hit.shape[1]
        for j, row in enumerate(hit):
            for i in range(n - 1):
                if row[i] == row[i + 1]:
                    continue
                inner = i if row[i] else i + 1
                way = -1 if row[i] else 1  # from the silhouette into the body
                known = -1.0
                if outlines is not None:
                    first, last = outlines[j - 1, i].tolist()
                    known = last if row[i] else 1 - first
                edge = i == 0 or i + 1 == n - 1
                s = self._fraction(known, edge, thick[j, inner],
                                   thick[j, inner + way] if row[inner + way] else 0.0)  # fmt: skip
                place = inner - way * s
                left, right = i, i + 1
                while left >= 0 and row[left] == row[i]:
                    out[j, left] = min(out[j, left], place - left)
                    left -= 1
                while right < n and row[right] == row[i + 1]:
                    out[j, right] = min(out[j, right], right - place)
                    right += 1
        return out

    @staticmethod
    def _fraction(known: float, edge: bool, t1: float, t2: float) -> float:
        """Fraction of a link, from the pixel that is hit, at which the silhouette crosses it."""
        if edge:
            return 0.5 if known < 0 else min(max(known, LEAST), 0.5)
        if known >= 0:
            return min(max(known, LEAST), 1 - LEAST)
        if t2 * t2 - t1 * t1 <= 0.5 * t1 * t1:
            return 0.5
        s = t1 * t1 / (t2 * t2 - t1 * t1)
        return max(s, LEAST) if s <= 0.9 else 0.9 - (s - 0.9) * 0.4 / 1.1

    def _bent(self, a: Array, hit: NDArray[np.bool_]) -> Array:
        """A surface less a twelfth of its second differences."""
        out = a.copy()
        for j, i in np.argwhere(hit):
            for dj, di in ((0, 1), (1, 0)):
                if hit[j - dj, i - di] and hit[j + dj, i + di]:
                    left, right = a[j - dj, i - di] - a[j, i], a[j + dj, i + di] - a[j, i]
                    smooth = self._smooth(max(abs(left), abs(right)))
                    out[j, i] -= smooth * (left + right) / 12
        return out

    def _carry_on(self, f: Array, b: Array, hit: NDArray[np.bool_]) -> None:
        """Extend front and back to the pixels around, along rows and then along columns."""
        known = hit.copy()
        for dj, di in ((0, 1), (1, 0)):
            fresh = known.copy()
            for j, i in np.argwhere(~known):
                values = []
                for sign in (-1, 1):
                    p, q = j + sign * dj, i + sign * di
                    r, s = p + sign * dj, q + sign * di
                    if not (0 <= p < f.shape[0] and 0 <= q < f.shape[1] and known[p, q]):
                        continue
                    further = 0 <= r < f.shape[0] and 0 <= s < f.shape[1] and known[r, s]
                    value = []
                    for a in (f, b):
                        slope = a[p, q] - a[r, s] if further else 0.0
                        value.append(a[p, q] + slope * self._smooth(slope))
                    values.append(value)
                if values:
                    low, high = np.mean(values, axis=0)
                    f[j, i], b[j, i] = (low, high) if low <= high else ((low + high) / 2,) * 2
                    fresh[j, i] = True
            known = fresh

    def _smooth(self, jump: float) -> float:
        """Share of a slope that is believed: all up to half the limit, none from the limit on."""
        return float(np.interp(abs(jump), (self.limit / 2, self.limit), (1, 0)))

    def _blend(self, a: float, b: float, s: float) -> float:
        """Between two pixels: a ramp, narrowed about the middle where it is too steep."""
        width = min(1.0, self.limit / abs(b - a)) if b != a else 1.0
        return float(np.interp(s, (0.5 - width / 2, 0.5 + width / 2), (a, b)))

    def sample(self, k: int, u: float, v: float) -> tuple[float, float, float]:
        """Front, back and margin of a slot at (u, v) in pixels, the ring being number 0."""
        rows, columns = self.f.shape[1:]
        i, j = min(int(u), columns - 2), min(int(v), rows - 2)
        out = []
        for a, steps in ((self.f[k], True), (self.b[k], True), (self.m[k], False)):
            mix = self._blend if steps else lambda p, q, s: p + (q - p) * s
            upper = mix(a[j, i], a[j, i + 1], u - i)
            lower = mix(a[j + 1, i], a[j + 1, i + 1], u - i)
            out.append(float(mix(upper, lower, v - j)))
        return out[0], out[1], out[2]

    def stretches(self, o: Array, d: Array) -> list[Stretch]:
        """Where the line o + t d runs inside, ascending and disjoint."""
        scale = np.array([1 / self.dx, 1 / self.dy])
        p, w = (o[:2] - self.origin) * scale, d[:2] * scale
        slots, rows, columns = self.f.shape
        if np.all(w == 0):
            if not (0 <= p[0] <= columns - 1 and 0 <= p[1] <= rows - 1):
                return []
            found = [self.sample(k, *p) for k in range(slots)]
            ends = [sorted(((f - o[2]) / d[2], (b - o[2]) / d[2]))
                    for f, b, m in found if m >= 0 and f < b]  # fmt: skip
            return unite([(a, b) for a, b in ends])
        times: list[float] = []
        for axis, count in enumerate((columns, rows)):
            if w[axis] != 0:
                times.extend((np.arange(count) - p[axis]) / w[axis])
        times = [t for t in sorted(set(times)) if self._in_image(p + t * w)]
        return unite([s for k in range(slots) for t, u in pairwise(times)
                      for s in self._piece(k, p, w, o[2], d[2], t, u)])  # fmt: skip

    def _in_image(self, q: Array) -> bool:
        rows, columns = self.f.shape[1:]
        return bool(np.all(q >= -1e-9) and np.all(q <= np.array([columns - 1, rows - 1]) + 1e-9))

    def _piece(
        self, k: int, p: Array, w: Array, oz: float, dz: float, t0: float, t1: float
    ) -> list[Stretch]:
        """Stretches between two grid lines; everything is linear between the corners of ramps."""
        top = np.array(self.f.shape[:0:-1]) - 1.0
        f0, b0, m0 = self.sample(k, *np.clip(p + t0 * w, 0, top))
        f1, b1, m1 = self.sample(k, *np.clip(p + t1 * w, 0, top))
        corners = {0.0, 1.0}
        for a, b in ((f0, f1), (b0, b1)):
            width = min(1.0, self.limit / abs(b - a)) if b != a else 1.0
            corners |= {0.5 - width / 2, 0.5 + width / 2}
        out = []
        for s0, s1 in pairwise(sorted(corners)):
            ends = []
            for s in (s0, s1):
                z = oz + (t0 + s * (t1 - t0)) * dz
                ends.append((m0 + (m1 - m0) * s, z - self._blend(f0, f1, s),
                             self._blend(b0, b1, s) - z))  # fmt: skip
            low, high = 0.0, 1.0
            for a, b in zip(*ends, strict=True):
                if a < 0 and b < 0:
                    low, high = 1.0, 0.0
                elif a < 0 <= b:
                    low = max(low, a / (a - b))
                elif b < 0 <= a:
                    high = min(high, a / (a - b))
            if low < high:
                start, end = (t0 + (s0 + x * (s1 - s0)) * (t1 - t0) for x in (low, high))
                out.append((start, end))
        return out


def rasterise_slowly(
    vertices: Array, faces: NDArray[np.int64], size: tuple[float, float],
    resolution: tuple[int, int], thickness: float = 0.0,
) -> list[list[list[Stretch]]]:  # fmt: skip
    """Intervals that the rays through all pixels meet, ``[row][column]``, by trying every triangle.

    Rays that meet an edge within rounding may count it twice or not at all.
    """
    rows, columns = resolution
    xs = ((np.arange(columns) + 0.5) / columns - 0.5) * size[0]
    ys = ((np.arange(rows) + 0.5) / rows - 0.5) * size[1]
    a, e1, e2 = vertices[faces[:, 0]], *(vertices[faces[:, k]] - vertices[faces[:, 0]]
                                         for k in (1, 2))  # fmt: skip
    normal = np.cross(e1, e2)
    facing = normal[:, 2] != 0
    a, e1, e2, normal = a[facing], e1[facing], e2[facing], normal[facing]
    cosine = np.abs(normal[:, 2]) / np.linalg.norm(normal, axis=1)
    out: list[list[list[Stretch]]] = []
    for y in ys:
        out.append([])
        for x in xs:
            s = np.array([x, y]) - a[:, :2]
            u = (s[:, 0] * e2[:, 1] - s[:, 1] * e2[:, 0]) / normal[:, 2]
            v = (e1[:, 0] * s[:, 1] - e1[:, 1] * s[:, 0]) / normal[:, 2]
            met = (u >= 0) & (v >= 0) & (u + v <= 1)
            z = (a[:, 2] + u * e1[:, 2] + v * e2[:, 2])[met]
            if thickness > 0:
                half = thickness / 2 / np.maximum(cosine[met], LEAST_COSINE)
                out[-1].append(unite(list(zip(z - half, z + half, strict=True))))
            else:
                order = np.argsort(z)
                winding = np.cumsum(np.sign(normal[met, 2])[order])
                ends = z[order].tolist()
                out[-1].append(unite([(ends[k], ends[k + 1]) for k in range(len(ends) - 1)
                                      if winding[k] != 0]))  # fmt: skip
    return out
