"""Shaded pictures of triangle meshes, drawn without OpenGL, and animations of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

import capsense as cs

Part = tuple[Any, cs.Pose, Any]
"""A mesh (``trimesh.Trimesh``), its pose in the world, and its colour: red, green, blue, 0 to 1."""
LIGHT = np.array((0.55, -0.5, 1.0)) / np.linalg.norm((0.55, -0.5, 1.0))
SKY, FLOOR = np.array((0.94, 0.95, 0.97)), np.array((0.80, 0.82, 0.85))
SHARP = np.radians(35.0)
"""Edges of larger angles are drawn as edges."""
_SMOOTH: dict[int, tuple[Any, Any]] = {}


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    field: float
    """Angle that the picture's height covers [rad]."""
    size: tuple[int, int]
    """Rows and columns."""

    @property
    def axes(self) -> np.ndarray:
        """Right, down and forward in the world, as rows, shape (3, 3)."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right = right / np.linalg.norm(right)
        return np.array([right, np.cross(forward, right), forward])

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return float(0.5 * self.size[0] / np.tan(0.5 * self.field))


@numba.njit(cache=True)
def _fill(p, normals, number, near, owner, normal):  # type: ignore[no-untyped-def]
    """Draw triangles: columns, rows and nearness of corners (m, 3, 3), their normals (m, 3, 3)."""
    rows, columns = near.shape
    for k in range(len(p)):
        (xa, ya, wa), (xb, yb, wb), (xc, yc, wc) = p[k]
        area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
        if area == 0.0 or min(wa, wb, wc) <= 0.0:
            continue
        for j in range(max(0, int(min(ya, yb, yc))), min(rows, int(max(ya, yb, yc)) + 2)):
            for i in range(max(0, int(min(xa, xb, xc))), min(columns, int(max(xa, xb, xc)) + 2)):
                b = ((i - xa) * (yc - ya) - (j - ya) * (xc - xa)) / area
                c = ((xb - xa) * (j - ya) - (yb - ya) * (i - xa)) / area
                a = 1.0 - b - c
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                w = a * wa + b * wb + c * wc
                if w > near[j, i]:
                    near[j, i], owner[j, i] = w, number
                    for d in range(3):
                        normal[j, i, d] = (
                            a * normals[k, 0, d] + b * normals[k, 1, d] + c * normals[k, 2, d]
                        )


def _corners(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a part's triangles in the world, and their normals, each of shape (m, 3, 3)."""
    mesh, pose, _ = part
    if id(mesh) not in _SMOOTH:
        _SMOOTH[id(mesh)] = (mesh, trimesh.graph.smooth_shade(mesh, angle=SHARP))
    smooth = _SMOOTH[id(mesh)][1]
    normals = np.asarray(smooth.vertex_normals) @ pose.rotation.T
    return pose.apply(smooth.vertices)[smooth.faces], normals[smooth.faces]


def picture(parts: Sequence[Part], camera: Camera, glowing: Sequence[Part] = ()) -> np.ndarray:
    """Draw parts over a floor at z = 0, lit from above, with shadows.

    Args:
        parts: What is lit.
        camera: Where from.
        glowing: What has its own colour whatever the light.

    Returns:
        Red, green and blue, 0 to 255, shape (rows, columns, 3).
    """
    rows, columns = 2 * camera.size[0], 2 * camera.size[1]
    axes, focal = camera.axes, 2 * camera.focal
    everything = [*parts, *glowing]
    triangles = [_corners(part) for part in everything]
    near, owner = np.zeros((rows, columns)), np.full((rows, columns), -1)
    normal = np.zeros((rows, columns, 3))
    for k, (points, normals) in enumerate(triangles):
        seen = (points - camera.position) @ axes.T
        depth = np.maximum(seen[..., 2:], 1e-3)
        where = focal * seen[..., :2] / depth + (0.5 * columns - 0.5, 0.5 * rows - 0.5)
        _fill(np.concatenate([where, 1 / depth], axis=-1), normals, k, near, owner, normal)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    rays = np.stack([x - 0.5 * columns + 0.5, y - 0.5 * rows + 0.5, np.full(x.shape, focal)], -1)
    rays = rays @ axes / focal
    ground = (owner < 0) & (rays[..., 2] < -1e-3)
    depth = np.where(near > 0, 1 / np.maximum(near, 1e-9), 0.0)
    depth[ground] = -camera.position[2] / rays[ground, 2]
    place = camera.position + rays * depth[..., None]
    normal[ground] = (0.0, 0.0, 1.0)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    normal *= -np.sign(np.sum(normal * rays, axis=-1, keepdims=True))

    colours = np.array([part[2] for part in everything] + [FLOOR])
    light = _lit(place, normal, rays, _shadow(triangles[: len(parts)], place, normal))
    light *= _openness(depth, owner >= 0, focal)[..., None]
    image = np.clip(colours[owner] ** 2.2 * light, 0.0, 1.0) ** (1 / 2.2)
    far = np.clip((np.linalg.norm(place[..., :2] - camera.target[:2], axis=-1) - 0.9) / 2.2, 0, 1)
    far = np.where(ground, far, np.where(owner < 0, 1.0, 0.0))[..., None]
    image = far * SKY + (1 - far) * image
    own = owner >= len(parts)
    image[own] = colours[owner[own]]
    fine = image.reshape(camera.size[0], 2, camera.size[1], 2, 3).mean(axis=(1, 3))
    return np.rint(255 * fine).astype(np.uint8)


def _lit(place: Any, normal: Any, rays: Any, shadow: Any) -> np.ndarray:
    """How much light a point gives back: the sky's, the lamp's, and a highlight."""
    towards = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    half = towards + LIGHT
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    lamp = np.clip(normal @ LIGHT, 0, 1) * shadow
    shine = 0.25 * np.clip(np.sum(normal * half, axis=-1), 0, 1) ** 40 * shadow
    return (0.42 + 0.18 * normal[..., 2] + 0.75 * lamp + shine)[..., None]


def _shadow(triangles: Sequence[Any], place: Any, normal: Any, size: int = 1400) -> np.ndarray:
    """Which points the lamp reaches, 0 to 1, softly."""
    right = np.cross(LIGHT, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(LIGHT, right), LIGHT])
    points = np.concatenate([p.reshape(-1, 3) for p, _ in triangles]) @ axes.T
    low, high = points.min(axis=0) - 0.02, points.max(axis=0) + 0.02
    pixel = float((high - low)[:2].max()) / size
    near, none = np.full((size, size), -1e9), np.zeros((size, size), np.int64)
    unused = np.zeros((size, size, 3))
    for corners, normals in triangles:
        _fill((corners @ axes.T - low) / (pixel, pixel, 1.0), normals, 0, near, none, unused)
    return _reached(((place + 0.004 * normal) @ axes.T - low) / (pixel, pixel, 1.0), near)


@numba.njit(cache=True)
def _reached(seen, near):  # type: ignore[no-untyped-def]
    """Share of 16 rays that reach the lamp, from columns, rows, heights (m, n, 3) in its image."""
    size = len(near)
    out = np.empty(seen.shape[:2])
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            x, y, height = seen[row, column]
            free = 0
            for dx in (-3.0, -1.0, 1.0, 3.0):
                for dy in (-3.0, -1.0, 1.0, 3.0):
                    i, j = round(x + dx), round(y + dy)
                    inside = 0 <= i < size and 0 <= j < size
                    if not inside or near[j, i] < height + 0.002:
                        free += 1
            out[row, column] = free / 16
    return out


def _openness(depth: np.ndarray, solid: np.ndarray, focal: float) -> np.ndarray:
    """Less than one where a point lies behind the solids around it, as in corners."""
    width = 0.03
    reach = width * focal / float(np.median(depth[solid]))
    there = solid[::2, ::2].astype(float)
    around = gaussian_filter(there * depth[::2, ::2], reach / 2)
    around /= np.maximum(gaussian_filter(there, reach / 2), 1e-6)
    gap = np.clip((depth - around.repeat(2, axis=0).repeat(2, axis=1)) / width, 0.0, None)
    return np.where(solid, 1.0 - 0.3 * gap * np.exp(-0.5 * gap**2), 1.0)


def capsule(radius: float, length: float) -> Any:
    """A capsule along z about the origin, as a mesh."""
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=(24, 24))
    mesh.apply_translation((0.0, 0.0, -mesh.bounds.mean(axis=0)[2]))
    return mesh


def frame_of(figure: Any) -> Any:
    """A figure as it is now, as one picture of an animation."""
    from PIL import Image

    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")


def save_animation(frames: Sequence[Any], file: Path, milliseconds: int) -> None:
    """Write frames as an endless animation, ``.webp``."""
    frames[0].save(
        file, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0,
        quality=72, method=4,
    )  # fmt: skip
