"""The sensor, the bodies and a plane of the potential, in three dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capsense._style import signal_colours
from capsense.design import Design
from capsense.design.geometry import Surface
from capsense.plotting.designs import ROLE_COLOURS
from capsense.reading import Charges, Touch
from capsense.scene import Body, Layers, Material, Pose, Scene, Shape, ShapeKind
from capsense.viewer.appearance import (
    CHARGE_DECADES,
    SEEN_THROUGH,
    blocks,
    charge_colours,
    colour_of,
    faces_of_hull,
)
from capsense.viewer.plane import Plane

if TYPE_CHECKING:
    from viser import ViserServer

    from capsense.viewer.frame import Frame, SolidView

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

LAYER: Colour = (206, 212, 178)
SHRUNK = 3e-4
"""So much [m] is taken off the faces of layers, so that sheets on them are in front of them."""
MAX_LABELS = 32
"""A design of more electrodes shows no names."""
SHADES = 31
"""Colours of an electrode beyond that of no signal."""
APART = 1000.0
"""Distance of an electrode's coloured copies [m]; see :func:`copies`."""
FAR = 20.0
"""What is further away than this is not drawn [m]."""
AXES = 0.03
"""Length of the axes that are drawn [m]."""
SPOTS, DOT = 6000, 1.2e-3
"""So many dots a body shows its charge with, and their radius [m]."""
PRESSED: Colour = (0, 114, 178)
"""Of the arrows of forces."""
ARROW = 0.03
"""Length of the arrow of the largest force so far [m]."""
_FACETED = (ShapeKind.BOX, ShapeKind.CYLINDER, ShapeKind.MESH)


class _Below:
    """A scene of viser, in which all that is added stands below a frame."""

    def __init__(self, scene: Any, root: str) -> None:
        self._scene, self._root = scene, root

    def __getattr__(self, method: str) -> Any:
        call = getattr(self._scene, method)
        return lambda name, *args, **options: call(self._root + name, *args, **options)


@dataclass(eq=False)
class _Drawn:
    """A solid that is drawn."""

    shape: Shape
    material: Material
    handle: Any
    faces: Array
    """Of its convex hull, as :func:`faces_of_hull` gives them."""
    pose: Pose
    """Where it was put last."""


class _Robot:
    """Draws the solids of a robot's simulator.

    Args:
        scene: A scene of viser.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._around: list[_Drawn] = []

    def show_around(self, solids: Sequence[SolidView]) -> None:
        """Put a robot's solids where they stand; those of other shapes are made anew."""
        same = len(solids) == len(self._around) and all(
            new.shape is old.shape and new.material == old.material
            for new, old in zip(solids, self._around, strict=True)
        )
        if not same:
            for old in self._around:
                old.handle.remove()
            self._around = [self._drawn(f"/robot/{k}", solid) for k, solid in enumerate(solids)]
        for solid, drawn in zip(solids, self._around, strict=True):
            drawn.pose = solid.pose
            _put(drawn.handle, solid.pose)

    def see_through(self, sights: Sequence[tuple[Array, Array]]) -> None:
        """Let the solids be transparent that hide something.

        Args:
            sights: Where eyes are [m], shape (3,), and what each looks at [m], shape (n, 3).
        """
        for drawn in self._around:
            away = drawn.pose.inverse()
            hides = any(blocks(drawn.faces, away.apply(eye), away.apply(p)) for eye, p in sights)
            opacity = SEEN_THROUGH if hides else None
            if drawn.handle.opacity != opacity:
                drawn.handle.opacity = opacity

    def _drawn(self, name: str, solid: SolidView) -> _Drawn:
        handle = self._solid(name, solid.shape, colour_of(solid.material), side="double")
        faces = faces_of_hull(solid.shape)
        return _Drawn(solid.shape, solid.material, handle, faces, solid.pose)

    def _solid(self, name: str, shape: Shape, colour: Colour, **options: Any) -> Any:
        mesh = shape.to_trimesh()
        flat = shape.kind in _FACETED
        return self._mesh(name, mesh.vertices, mesh.faces, colour, flat_shading=flat, **options)

    def _mesh(self, name: str, vertices: Any, faces: Any, colour: Any, **options: Any) -> Any:
        return self._scene.add_mesh_simple(
            name, vertices, faces, color=colour, cast_shadow=False, receive_shadow=False, **options
        )


class SceneDrawing(_Robot):
    """Draws into a server; lengths are metres in the sensor frame.

    Args:
        server: Shows it to all who are connected.
        design: The sensor.
        root: The frame of the sensor, where it is one of several: it is drawn without its domain,
            names and scales.
        robot: Corners of the box around the robot that carries the sensor [m], shape (2, 3); the
            camera frames it.
    """

    def __init__(
        self, server: ViserServer, design: Design, root: str = "", robot: Array | None = None
    ) -> None:
        super().__init__(_Below(server.scene, root) if root else server.scene)
        self._bodies: list[tuple[Any, ...]] = []
        self._spots: list[Array] = []
        self._shades = np.zeros(len(design.electrodes), dtype=int)
        self._middles = np.array([e.surface.bounds.mean(axis=0) for e in design.electrodes])
        self._normals = np.array([_normal(e.surface) for e in design.electrodes])
        self._arrows: Any = None
        self._largest_force = 0.0
        server.scene.configure_default_lights(cast_shadow=False)
        self._draw_stack(design)
        self._plates = [
            self._scene.add_glb(
                f"/electrodes/{k}", copies(e.surface.triangles.reshape(-1, 3)), cast_shadow=False,
                receive_shadow=False,
            ) for k, e in enumerate(design.electrodes)
        ]  # fmt: skip
        if root:
            return
        self._draw_domain(design)
        self._draw_scale(design)
        if len(design.electrodes) <= MAX_LABELS:
            for k, e in enumerate(design.electrodes):
                self._label(f"/labels/{k}", e.name, e.surface.bounds.mean(axis=0))
        low, high = np.array([e.surface.bounds for e in design.electrodes]).transpose(1, 0, 2)
        middle = (low.min(axis=0) + high.max(axis=0)) / 2
        reach = max(0.08, float(np.ptp([low.min(axis=0), high.max(axis=0)], axis=0).max()))
        self.views = {"sensor": _view(middle + np.array([0.0, 0.0, 0.4 * reach]), 3.7 * reach)}
        if robot is not None:
            self.views["robot"] = _view_of(robot, self._middles)
        _look_at(server, self.views)

    def show(self, frame: Frame, loudest: float) -> None:
        """Put bodies and the robot where they stand, and colour the electrodes.

        Args:
            frame: What is shown.
            loudest: Change of an electrode that colours it fully [F].
        """
        self.show_bodies(Scene() if frame.around else frame.scene)
        self.show_around(frame.around)
        self.show_signals(np.abs(np.diag(frame.reading.delta)) / loudest)
        self.show_touch(frame.reading.touch)

    def reveal(self, eyes: Array) -> None:
        """Let solids be transparent that hide electrodes from eyes [m], shape (e, 3)."""
        self.see_through([(eye, self._middles) for eye in eyes])

    def show_signals(self, strength: Array) -> None:
        """Colour the electrodes by their signals, 0 to 1, shape (M,)."""
        shades = np.rint(SHADES * np.clip(strength, 0.0, 1.0)).astype(int)
        for k in np.flatnonzero(shades != self._shades).tolist():
            self._plates[k].position = (0.0, 0.0, -APART * float(shades[k]))
        self._shades = shades

    def show_touch(self, touch: Touch | None, largest: float | None = None) -> None:
        """Draw an arrow onto each electrode whose cover carries a force, as long as that is large.

        Args:
            touch: What is pressed, if there is a cover.
            largest: The force of the longest arrow [N]; that of this sensor so far by default.
        """
        force = np.zeros(0) if touch is None else touch.force
        if largest is None:
            largest = self._largest_force = max(self._largest_force, force.max(initial=0.0))
        pressed = np.flatnonzero(force > 0.0)
        if not len(pressed):
            if self._arrows is not None:
                self._arrows.visible = False
            return
        tips = self._middles[pressed]
        length = ARROW * force[pressed] / largest
        tails = tips + length[:, None] * self._normals[pressed]
        points = np.stack([tails, tips], axis=1).astype(np.float32)
        if self._arrows is None:
            self._arrows = self._scene.add_arrows(
                "/touch", points, PRESSED, shaft_radius=1.2e-3, head_radius=3e-3, head_length=6e-3
            )
        self._arrows.points = points
        self._arrows.visible = True

    def show_bodies(self, scene: Scene) -> None:
        """Put the bodies where they stand; those of other shapes are made anew."""
        bodies = list(scene)
        same = len(bodies) == len(self._bodies) and all(
            new.shape is old.shape and new.material == old.material
            for new, (old, *_) in zip(bodies, self._bodies, strict=True)
        )
        if not same:
            for handle in [h for _, *handles in self._bodies for h in handles]:
                handle.remove()
            labels = _labels(bodies)
            self._bodies = [self._named(k, b, labels.get(k)) for k, b in enumerate(bodies)]
            self._spots = [spots_of(b) for b in bodies]
        for body, (_, *handles) in zip(bodies, self._bodies, strict=True):
            for handle in handles:
                _put(handle, body.pose)

    def show_plane(self, plane: Plane, potential: Array) -> None:
        """Draw lines of the potential at a plane's points [V], shape (n,)."""
        pieces, colours = plane.contours(potential)
        if not len(pieces):
            self.hide("/potential")
            return
        self._scene.add_line_segments(
            "/potential", pieces, colours, thickness=2.2, thickness_units="screen"
        )

    def show_charges(self, charges: Charges | None, terminal: int) -> None:
        """Dots on the bodies, the darker the more charge a terminal at 1 V draws there."""
        if charges is None:
            self.hide("/charge")
            return
        spots = [b.pose.apply(s) for (b, *_), s in zip(self._bodies, self._spots, strict=True)]
        points = np.concatenate([*spots, charges.points]) if spots else charges.points
        far, near = cKDTree(charges.points).query(points, k=min(4, len(charges.points)))
        weight = 1.0 / (far.reshape(len(points), -1) + 0.1 * charges.pitch) ** 2
        found = charges.density[near.reshape(len(points), -1), terminal]
        density = (weight * found).sum(axis=1) / weight.sum(axis=1)
        share = 1.0 + np.log10(np.maximum(density / density.max(), 1e-9)) / CHARGE_DECADES
        shown = (share > 0) & (weight.max(axis=1) > 1.0 / charges.pitch**2)
        self._scene.add_point_cloud(
            "/charge", points[shown], charge_colours(share[shown]), point_shading="flat",
            point_shape="circle", point_size=DOT,
        )  # fmt: skip

    def hide(self, name: str) -> None:
        """Take something away."""
        self._scene.remove_by_name(name)

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
            opacity = SEEN_THROUGH if _covers(layer.surface, design) else None
            if layer.facets:
                self._sheet(f"/layers/{k}", layer.surface, LAYER, opacity)
                continue
            less = min(SHRUNK, 0.2 * float(layer.upper[2] - layer.lower[2]))
            size = layer.upper - layer.lower - [0.0, 0.0, 2 * less]
            self._scene.add_box(
                f"/layers/{k}", color=LAYER, dimensions=tuple(size),
                position=(layer.lower + layer.upper) / 2, cast_shadow=False, opacity=opacity,
            )  # fmt: skip
        for k, conductor in enumerate(design.conductors):
            colour = bytes.fromhex(ROLE_COLOURS[conductor.role].removeprefix("#"))
            opacity = SEEN_THROUGH if _covers(conductor.surface, design) else None
            self._sheet(f"/conductors/{k}", conductor.surface, tuple(colour), opacity)

    def _sheet(self, name: str, surface: Surface, colour: Any, opacity: float | None) -> None:
        corners = surface.triangles.reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        self._mesh(name, corners, faces, colour, flat_shading=True, side="double", opacity=opacity)

    def _named(self, number: int, body: Body, label: str | None) -> tuple[Any, ...]:
        """A body, what is drawn of it, and its label, if it has one."""
        name, shape = f"/bodies/{number}", body.shape
        colour = colour_of(body.material)
        if isinstance(shape, Layers):
            drawn = self._dots(name, shape, colour)
        else:
            side = "double" if shape.kind == ShapeKind.SURFACE else "front"
            drawn = self._solid(name, shape, colour, side=side, opacity=0.4)
        return (
            (body, drawn)
            if label is None
            else (body, drawn, self._label(f"/names/{number}", label))
        )

    def _label(self, name: str, text: str, position: Any = (0.0, 0.0, 0.0), **options: Any) -> Any:
        options = {"anchor": "center-center", **options}
        return self._scene.add_label(
            name, text, position=position, font_screen_scale=0.8, **options
        )

    def _draw_scale(self, design: Design) -> None:
        """Axes of the sensor frame in its origin, and a grid of 10 mm beneath."""
        self._scene.add_frame("/axes", axes_length=AXES, axes_radius=4e-4, origin_radius=8e-4)
        for name, at in zip("xyz", AXES * np.eye(3), strict=True):
            self._scene.add_label(f"/axes/{name}", name, position=1.1 * at, font_screen_scale=0.8)
        low, high = design.domain.lower, design.domain.upper
        middle, size = (low + high) / 2, high - low
        self._scene.add_grid(
            "/grid", float(size[0]), float(size[1]), cell_size=0.01, section_size=0.05,
            cell_color=(228, 230, 233), section_color=(206, 209, 213),
            cell_thickness=0.5, section_thickness=0.8, position=(middle[0], middle[1], low[2]),
        )  # fmt: skip
        self._scene.add_label(
            "/grid_scale", "grid: 10 mm, 50 mm", position=(high[0], low[1], low[2]),
            font_screen_scale=0.8,
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


def _labels(bodies: Sequence[Body]) -> dict[int, str]:
    """What is written at which bodies: their names; of one conductor, its name at the first."""
    first: dict[str, int] = {}
    found = {}
    for k, body in enumerate(bodies[:MAX_LABELS]):
        label = body.conductor or body.name
        if label is not None and (body.conductor is None or first.setdefault(label, k) == k):
            found[k] = label
    return found


class SkinDrawing:
    """Draws all sensors of a skin; lengths are metres in the frame of the world.

    Args:
        server: Shows it to all who are connected.
        designs: Name → sensor.
        middles: Where they stand at first [m], shape (s, 3).
        robot: Corners of the box around the robot that carries them [m], shape (2, 3), if there is
            one; the camera frames it.
    """

    def __init__(
        self, server: ViserServer, designs: Mapping[str, Design], middles: Array,
        robot: Array | None = None,
    ) -> None:  # fmt: skip
        self._frames = {
            name: server.scene.add_frame(f"/skin/{k}", show_axes=False)
            for k, name in enumerate(designs)
        }
        self._parts = [
            SceneDrawing(server, design, f"/skin/{k}") for k, design in enumerate(designs.values())
        ]
        self._robot = _Robot(server.scene)
        self._largest_force = 0.0
        self._places, self._outwards = middles, np.zeros_like(middles)
        around = max(0.15, 0.3 * float(np.linalg.norm(np.ptp(middles, axis=0))))
        box = np.stack([middles.min(axis=0) - around, middles.max(axis=0) + around])
        self.views = {"skin": _view_of(box, middles)}
        if robot is not None:
            self.views["robot"] = _view_of(robot, middles)
        _look_at(server, self.views)

    def show(self, frame: Frame, loudest: float) -> None:
        """Put the sensors and the robot where they stand, and colour the electrodes.

        Args:
            frame: What is shown; it holds a skin.
            loudest: Change of an electrode that colours it fully [F].
        """
        self._robot.show_around(frame.around)
        forces = [part.touch.force.max() for part in frame.skin.values() if part.touch is not None]
        self._largest_force = max(self._largest_force, *forces, 0.0, 0.0)
        for drawing, (name, part) in zip(self._parts, frame.skin.items(), strict=True):
            _put(self._frames[name], part.pose)
            drawing.show_signals(part.changes / loudest)
            drawing.show_touch(part.touch, self._largest_force)
        poses = [part.pose for part in frame.skin.values()]
        self._places = np.array([pose.position for pose in poses])
        self._outwards = np.array([pose.rotation[:, 2] for pose in poses])

    def reveal(self, eyes: Array) -> None:
        """Let solids be transparent that hide sensors which face eyes [m], shape (e, 3)."""
        sights = []
        for eye in eyes:
            facing = ((eye - self._places) * self._outwards).sum(axis=1) > 0.0
            sights.append((eye, self._places[facing]))
        self._robot.see_through(sights)


View = tuple[Array, Array]
"""Where a camera is, and what it looks at [m], shape (3,) each."""
FIELD_OF_VIEW = 0.8
"""Height of the picture [rad]."""


def _view(middle: Array, distance: float) -> View:
    """From the front, the right and above, at a distance [m]."""
    towards = np.array([1.3, -3.0, 1.7])
    return middle + distance * towards / np.linalg.norm(towards), middle


def _view_of(box: Array, points: Array) -> View:
    """One that holds a box and some points [m], shapes (2, 3) and (n, 3)."""
    ends = np.concatenate([box, points])
    low, high = ends.min(axis=0), ends.max(axis=0)
    radius = 0.5 * float(np.linalg.norm(high - low))
    return _view(0.5 * (low + high), radius / np.sin(0.5 * FIELD_OF_VIEW))


def _look_at(server: ViserServer, views: Mapping[str, View]) -> None:
    """Give those who come the last of some views."""
    camera = server.initial_camera
    camera.near, camera.far, camera.fov = 1e-3, FAR, FIELD_OF_VIEW
    camera.position, camera.look_at = list(views.values())[-1]


def _covers(surface: Surface, design: Design) -> bool:
    """Whether some of a layer or a sheet is in front of an electrode."""
    low, high = surface.bounds
    return any(
        low[2] >= e.surface.bounds[1, 2] and (low[:2] < e.surface.bounds[1, :2]).all()
        and (high[:2] > e.surface.bounds[0, :2]).all()
        for e in design.electrodes
    )  # fmt: skip


def _normal(surface: Surface) -> Array:
    """Mean unit normal of a surface, shape (3,)."""
    total = sum(np.asarray(f.axes[2]) * f.polygon.area for f in surface.facets)
    length = float(np.linalg.norm(total))
    return total / length if length > 0 else np.array([0.0, 0.0, 1.0])


def _put(handle: Any, pose: Pose) -> None:
    """Put what is drawn to a pose."""
    x, y, z, w = pose.quaternion
    handle.wxyz, handle.position = (w, x, y, z), pose.position


def spots_of(body: Body) -> Array:
    """Points spread over a body's surface, in its own frame [m]; none of images and soft bodies."""
    if body.shape.kind in (ShapeKind.LAYERS, ShapeKind.SURFACE):
        return np.empty((0, 3))
    import trimesh

    points, _ = trimesh.sample.sample_surface(body.shape.to_trimesh(), SPOTS, seed=0)
    return np.asarray(points)


def copies(corners: Array) -> bytes:
    """Triangles in each of the colours of a signal, whatever the light, as one glTF file.

    Copy n stands ``APART`` · n along z. One of them is where it belongs, the others are further
    than what is drawn. So a change of colour is a movement, which a page shows from one frame to
    the next; a new file would have to be read first, with nothing to be seen meanwhile.

    Args:
        corners: Three for each triangle [m], shape (3 n, 3).
    """
    import trimesh

    def tree(gltf: dict[str, Any]) -> None:
        gltf["extensionsUsed"] = ["KHR_materials_unlit"]
        for material in gltf["materials"]:
            material["extensions"] = {"KHR_materials_unlit": {}}
            material["doubleSided"] = True

    scene, faces = trimesh.Scene(), np.arange(len(corners)).reshape(-1, 3)
    for shade, colour in enumerate(signal_colours(np.arange(SHADES + 1) / SHADES)):
        part = colour / 255  # glTF holds factors of linear light
        linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        mesh = trimesh.Trimesh(corners, faces, process=False)
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*linear, 1.0])
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        place = trimesh.transformations.translation_matrix([0.0, 0.0, APART * shade])
        scene.add_geometry(mesh, node_name=f"{shade}", transform=place)
    return bytes(trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=tree))
