"""The sensor, the bodies and a plane of the potential, in three dimensions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense._style import QUIET, signal_colours
from capsense.design import Design
from capsense.design.draw import ROLE_COLOURS
from capsense.design.geometry import Surface
from capsense.scene import Body, Layers, Scene, ShapeKind
from capsense.viewer.plane import Plane, paint

if TYPE_CHECKING:
    from viser import ViserServer

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

LAYER: Colour = (206, 212, 178)
CONDUCTIVE: Colour = (120, 134, 150)
DIELECTRIC: Colour = (150, 190, 205)
SHRUNK = 3e-4
"""So much [m] is taken off the faces of layers, so that sheets on them are in front of them."""
MAX_LABELS = 32
"""A design of more electrodes shows no names."""
_FACETED = (ShapeKind.BOX, ShapeKind.CYLINDER, ShapeKind.MESH)


class Stage:
    """Draws into a server; lengths are metres in the sensor frame.

    Args:
        server: Shows it to all who are connected.
        design: The sensor.
    """

    def __init__(self, server: ViserServer, design: Design) -> None:
        self._scene = server.scene
        self._bodies: list[tuple[Body, Any]] = []
        self._shown: list[Colour] = []
        server.scene.configure_default_lights(cast_shadow=False)
        self._draw_domain(design)
        self._draw_stack(design)
        self._electrodes = [
            self._sheet(f"/electrodes/{k}", e.surface, QUIET)
            for k, e in enumerate(design.electrodes)
        ]
        if len(design.electrodes) <= MAX_LABELS:
            for k, e in enumerate(design.electrodes):
                self._scene.add_label(
                    f"/labels/{k}", e.name, position=e.surface.bounds.mean(axis=0),
                    anchor="center-center", font_screen_scale=0.8,
                )  # fmt: skip
        low, high = np.array([e.surface.bounds for e in design.electrodes]).transpose(1, 0, 2)
        middle = (low.min(axis=0) + high.max(axis=0)) / 2
        reach = max(0.08, float(np.ptp([low.min(axis=0), high.max(axis=0)], axis=0).max()))
        camera = server.initial_camera
        camera.near, camera.far = 1e-3, 20.0
        camera.look_at = middle + np.array([0.0, 0.0, 0.4 * reach])
        camera.position = middle + reach * np.array([1.3, -3.0, 1.7])
        camera.fov = 0.8

    def show_signals(self, strength: Array) -> None:
        """Colour the electrodes by their signals, 0 to 1, shape (M,)."""
        colours: list[Colour] = [(int(r), int(g), int(b)) for r, g, b in signal_colours(strength)]
        for k, (handle, colour) in enumerate(zip(self._electrodes, colours, strict=True)):
            if not self._shown or self._shown[k] != colour:
                handle.color = colour
        self._shown = colours

    def show_bodies(self, scene: Scene) -> None:
        """Put the bodies where they stand; those of other shapes are made anew."""
        bodies = list(scene)
        same = len(bodies) == len(self._bodies) and all(
            new.shape is old.shape and new.material == old.material
            for new, (old, _) in zip(bodies, self._bodies, strict=True)
        )
        if not same:
            for _, handle in self._bodies:
                handle.remove()
            self._bodies = [(b, self._solid(f"/bodies/{k}", b)) for k, b in enumerate(bodies)]
        for body, (_, handle) in zip(bodies, self._bodies, strict=True):
            x, y, z, w = body.pose.quaternion
            handle.wxyz, handle.position = (w, x, y, z), body.pose.position

    def show_plane(self, plane: Plane, potential: Array) -> None:
        """Paint the potential at a plane's points [V], shape (n,).

        As points, which hide and are hidden as they should be: an image would be sorted as a whole
        among the bodies that light passes through.
        """
        shown, colours = paint(plane.carried(potential))
        self._scene.add_point_cloud(
            "/potential", plane.drawn[shown], colours, point_size=0.6 * plane.pitch,
            point_shape="square", point_shading="flat",
        )  # fmt: skip

    def hide_plane(self) -> None:
        """Take the plane away."""
        self._scene.remove_by_name("/potential")

    def _draw_domain(self, design: Design) -> None:
        low, high = design.domain.lower, design.domain.upper
        corners = np.array([[(low, high)[n >> k & 1][k] for k in range(3)] for n in range(8)])
        edges = [(a, a | 1 << k) for a in range(8) for k in range(3) if not a >> k & 1]
        self._scene.add_line_segments(
            "/domain", corners[np.array(edges)], (170, 178, 184), thickness=1.0,
            thickness_units="screen",
        )  # fmt: skip

    def _draw_stack(self, design: Design) -> None:
        for k, layer in enumerate(design.layers):
            less = min(SHRUNK, 0.2 * float(layer.upper[2] - layer.lower[2]))
            size = layer.upper - layer.lower - [0.0, 0.0, 2 * less]
            self._scene.add_box(
                f"/layers/{k}", color=LAYER, dimensions=tuple(size),
                position=(layer.lower + layer.upper) / 2, cast_shadow=False,
            )  # fmt: skip
        for k, conductor in enumerate(design.conductors):
            value = ROLE_COLOURS[conductor.role].removeprefix("#")
            red, green, blue = bytes.fromhex(value)
            self._sheet(f"/conductors/{k}", conductor.surface, (red, green, blue))

    def _sheet(self, name: str, surface: Surface, colour: Colour) -> Any:
        corners = surface.triangles.reshape(-1, 3)
        return self._scene.add_mesh_simple(
            name, corners, np.arange(len(corners)).reshape(-1, 3), color=colour, side="double",
            flat_shading=True, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _solid(self, name: str, body: Body) -> Any:
        colour = CONDUCTIVE if body.material.is_conductor() else DIELECTRIC
        if isinstance(body.shape, Layers):
            return self._dots(name, body.shape, colour)
        mesh = body.shape.to_trimesh()
        return self._scene.add_mesh_simple(
            name, mesh.vertices, mesh.faces, color=colour, opacity=0.4, cast_shadow=False,
            flat_shading=body.shape.kind in _FACETED, receive_shadow=False,
            side="double" if body.shape.kind == ShapeKind.SURFACE else "front",
        )  # fmt: skip

    def _dots(self, name: str, layers: Layers, colour: Colour) -> Any:
        """What a depth camera saw: a dot for every pixel, with gaps to look through."""
        slot, row, column = np.nonzero(layers.hit)
        width, height = layers.pixel
        x, y = (column + 0.5) * width, (row + 0.5) * height
        front = layers.front[slot, row, column]
        points = np.column_stack([x - 0.5 * layers.size[0], y - 0.5 * layers.size[1], front])
        return self._scene.add_point_cloud(
            name, points, colour, point_size=0.2 * min(width, height), point_shape="circle",
            point_shading="flat",
        )  # fmt: skip
