"""Layouts of electrodes on links: spread evenly, at the places of taxels, or painted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree

from capsense._validate import as_number
from capsense.design import load_design
from capsense.design.film import Film
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.scene import Pose
from capsense.scene.surface import connected_parts
from capsense.skin.frames import read_frames
from capsense.skin.layout import FLATTEST, Pad, SkinLayout, checked_length, pad_design
from capsense.skin.surface import (
    Fit,
    LinkMesh,
    Samples,
    fit,
    link_area,
    on_smooth_surface,
    principal_axes,
    read_link,
    sample,
    spread,
    visible,
)
from capsense.skin.taxels import Taxels, checked_taxels, read_taxels

Array = NDArray[np.float64]
Region = tuple[Sequence[float], Sequence[float]] | Callable[[Array, Array], NDArray[np.bool_]]

_PAD, _TAXEL = Pad(), Pad(0.004)
_CLASS = 1e-4
"""Patches of one design differ in how far they bulge, and painted ones in their outlines, by no
more than about this [m]."""
_CANDIDATES = (40, 4_000, 20_000)
"""Places that are looked at: so many a patch, at least, and at most."""
_GRID = 1e-5
"""Outlines of painted electrodes are rounded to this [m]."""


def from_mesh(
    link: object,
    *,
    count: int | None = None,
    spacing: float | None = None,
    region: Region | None = None,
    patch: Pad | Design | str | Path = _PAD,
    unit: str = "m",
) -> SkinLayout:
    """Spread electrodes evenly over the outer surface of a link.

    Each electrode is a disc on the surface, with a housing behind it. Discs are bent with the link,
    and radii are rounded so that few designs are needed.

    Args:
        link: Path of a mesh file, a ``TriMesh``, or anything with ``vertices`` and ``faces``, in
            the frame of the link.
        count: How many patches; by default as many as ``spacing`` allows.
        spacing: Least straight distance between their middles [m]; by default ``size``.
        region: Where patches may be: lower and upper corner of a box [m] in the frame of the link,
            or a function of points (n, 3) and normals (n, 3) that returns booleans (n,).
        patch: The electrode of each patch; or one design for all of them: a ``Design``, a packaged
            name or a file.
        unit: Of the mesh: ``"m"``, ``"mm"``, ``"cm"`` or ``"in"``.

    Raises:
        SceneError: The mesh or an option is wrong, or ``count`` patches do not fit.
        DesignError: The design is wrong.
    """
    wanted = _checked_count(count, spacing)
    chosen_patch, width = _checked_patch(patch)
    apart = width if spacing is None else checked_length("spacing", spacing)
    if apart < width:
        raise SceneError(
            f"spacing is {1e3 * apart:g} mm, less than the {1e3 * width:g} mm of a patch, so they "
            "would overlap; increase spacing or make the patch smaller"
        )
    mesh = read_link(link, unit)
    samples = sample(mesh, width)
    tree = KDTree(samples.points)
    expected = wanted or math.ceil(1.5 * link_area(mesh) / apart**2)
    many = int(np.clip(_CANDIDATES[0] * expected, *_CANDIDATES[1:]))
    step = max(1, len(samples.points) // many)
    places = Samples(samples.points[::step], samples.normals[::step])
    places = _within(places, region)
    if len(places.points):
        places = _chosen(places, on_smooth_surface(places, samples, tree, 0.5 * width))
    if len(places.points):
        places = _chosen(places, visible(mesh, places))
    at = spread(places, wanted or len(places.points), apart)
    if not len(at) or len(at) < (wanted or 0):
        raise SceneError(
            f"{len(at)} patches of {1e3 * width:g} mm fit {1e3 * apart:g} mm apart on the smooth "
            f"outer surface{'' if region is None else ' in the region'}, not {wanted or 'one'}; "
            "decrease count, spacing or the patch's size, or extend region"
        )
    chosen = Samples(places.points[at], places.normals[at])
    frames = fit(chosen, samples, tree, 0.5 * width, principal_axes(mesh))
    names = [f"patch_{k:0{len(str(len(at) - 1))}d}" for k in range(len(at))]
    designs = _designs(frames, chosen_patch)
    return _layout(names, chosen.points, frames, designs, samples, tree, {}).warn()


def from_taxels(
    taxels: str | Path | ArrayLike,
    normals: ArrayLike | None = None,
    *,
    frames: str | None = None,
    link: object | None = None,
    pose: Pose | None = None,
    patch: Pad | Design | str | Path = _TAXEL,
    unit: str = "m",
) -> SkinLayout:
    """Put an electrode at the place of each taxel of a list.

    A ``.csv`` file has the columns x, y, z, nx, ny, nz and optionally name. A ``.txt`` or ``.ini``
    file has them, without a header, after the line ``[calibration]``, as the position files of
    iCub's skins do: lines of zeros stand for taxels that are not there, and of several taxels at
    one place the first is taken. ``left_out`` of the layout names the others. Of a ``.urdf`` file,
    the frames named by ``frames`` are taken, whose z axes point out of the link.

    Args:
        taxels: Path of a file, or positions, shape (n, 3).
        normals: Normals out of the link, shape (n, 3), with positions.
        frames: With a ``.urdf`` file, which of its links are taxels, such as
            ``"l_forearm_skin_*"``. One link must carry all of them by fixed joints: the first one
            above them that a joint moves, or the root. Places are in its frame.
        link: Mesh of the link in its frame [m], from which electrodes take how they are bent; by
            default they are flat.
        pose: Frame of the taxels in the frame of the link.
        patch: The electrode of each taxel, by default of 4 mm; or one design for all of them.
        unit: Of the positions: ``"m"``, ``"mm"``, ``"cm"`` or ``"in"``.

    Raises:
        SceneError: The file, an array or an option is wrong.
        DesignError: The design is wrong.
    """
    chosen_patch, width = _checked_patch(patch)
    urdf = isinstance(taxels, str | Path) and Path(taxels).suffix.lower() == ".urdf"
    if urdf != (frames is not None):
        raise SceneError(
            f"frames is {frames!r}; give a pattern of link names with the path of a .urdf file, "
            "and none without"
        )
    if isinstance(taxels, str | Path):
        if frames is None:
            found = read_taxels(Path(taxels), unit)
        else:
            found = _from_frames(Path(taxels), frames)
    else:
        found = _from_arrays(taxels, normals, unit)
    at = Pose() if pose is None else pose
    points = Samples(at.apply(found.positions), found.normals @ at.rotation.T)
    if link is None:
        axes = np.eye(3)
        tree, samples = KDTree(points.points), Samples(np.zeros((0, 3)), np.zeros((0, 3)))
        flat = fit(points, Samples(points.points, -points.normals), tree, 1e-9, axes)
        fits = Fit(flat.rotation, np.zeros((len(points.points), 2)))
    else:
        mesh = read_link(link, "m")
        samples = sample(mesh, width)
        tree = KDTree(samples.points)
        fits = fit(points, samples, tree, 0.5 * width, principal_axes(mesh))
    designs = _designs(fits, chosen_patch)
    return _layout(found.names, points.points, fits, designs, samples, tree, found.left_out).warn()


def paint(
    link: object,
    mask: ArrayLike | None = None,
    *,
    depth: float = 0.003,
    housing: Literal["shield", "ground"] = "shield",
    unit: str = "m",
) -> SkinLayout:
    """Make an electrode of each connected region of a label that is painted on a link.

    The outline of a region is unrolled from the cylinder that fits it best. Regions of which
    outline and bulge agree within 0.1 mm, also turned half round, share a design.

    Args:
        link: Path of a mesh file, or something that has ``vertices`` and ``faces``, in the frame of
            the link.
        mask: A label for each vertex or each face: whole numbers or booleans, where 0 and less
            paint nothing; or colours, shape (n, 3) or (n, 4), where the most frequent one paints
            nothing. By default the colours of the file.
        depth: Distance of the electrodes from the housing [m].
        housing: Whether the link is driven as a ``"shield"`` or is ``"ground"``.
        unit: Of the mesh: ``"m"``, ``"mm"``, ``"cm"`` or ``"in"``.

    Raises:
        SceneError: The mesh or the mask is wrong, nothing is painted, or a region does not unroll.
        DesignError: A region is no electrode, such as one that is too thin.
    """
    pad = Pad(depth=depth, housing=housing)
    mesh = read_link(link, unit)
    labels = _face_labels(mesh, _file_colours(link) if mask is None else np.asarray(mask))
    _, welded = np.unique(np.rint(mesh.vertices / 1e-8), axis=0, return_inverse=True)
    joined = welded.reshape(-1)[mesh.faces]
    axes = principal_axes(mesh)
    patches: dict[str, tuple[Design, Pose]] = {}
    deviation = {}
    kinds: list[tuple[_Painted, Design]] = []
    for label in np.unique(labels[labels > 0]).tolist():
        painted = np.flatnonzero(labels == label)
        part = connected_parts(joined[painted], int(joined.max()) + 1)
        for k in range(int(part.max()) + 1):
            name = f"region_{label}" + (f"_{k}" if part.max() else "")
            one = LinkMesh(mesh.vertices, mesh.faces[painted[part == k]])
            found = _region(name, one, axes, 2 * pad.depth)
            for first, design in kinds:
                turned = found.turned_like(first)
                if turned is not None:
                    patches[name] = design, turned
                    break
            else:
                patches[name] = found.design(pad), found.pose
                kinds.append((found, patches[name][0]))
            deviation[name] = found.off
    return SkinLayout(patches, deviation).warn()


class _Painted(NamedTuple):
    """A painted region, unrolled from its cylinder."""

    outline: shapely.Polygon
    """In the film [m]; its centroid is the origin."""
    radius: float
    """Of the cylinder [m], infinite where the region is flat."""
    pose: Pose
    """Of the film in the frame of the link."""
    off: float
    """How far the film leaves the surface [m]."""

    def design(self, pad: Pad) -> Design:
        """The electrode of the region."""
        shape: dict[str, Any] = {"shape": "polygon", "points": _ring(self.outline.exterior)}
        if self.outline.interiors:
            shape["holes"] = [_ring(r) for r in self.outline.interiors]
        return pad_design(shape, self._size, self.radius, pad)

    def turned_like(self, other: _Painted) -> Pose | None:
        """Where the design of another region stands for this one; None where they differ."""
        bulge = abs(1 / self.radius - 1 / other.radius) * self._size**2 / 8
        if bulge > _CLASS or math.isinf(self.radius) != math.isinf(other.radius):
            return None
        for turn in (Pose(), Pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))):
            sign = 1.0 if turn.quaternion[3] else -1.0
            mine = shapely.transform(self.outline, lambda xy, sign=sign: sign * xy)
            if shapely.hausdorff_distance(mine.boundary, other.outline.boundary) < _CLASS:
                return self.pose @ turn
        return None

    @property
    def _size(self) -> float:
        x0, y0, x1, y1 = self.outline.bounds
        return float(max(x1 - x0, y1 - y0))


def _region(name: str, mesh: LinkMesh, axes: Array, least: float) -> _Painted:
    """Unroll a painted region from a cylinder of a radius of ``least`` [m] or more."""
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    centre = np.average(corners.mean(axis=1), axis=0, weights=area)
    samples = sample(mesh, 2 * math.sqrt(area.sum()))
    nearest = int(np.linalg.norm(samples.points - centre, axis=1).argmin())
    mean = cross.sum(axis=0)
    if np.linalg.norm(mean) < 0.2 * area.sum():
        raise SceneError(f"{name} goes round the link, so it does not unroll; paint two regions")
    middle = Samples(samples.points[[nearest]], (mean / np.linalg.norm(mean))[None])
    reach = 0.5 * float(np.linalg.norm(np.ptp(samples.points, axis=0)))
    frames = fit(middle, samples, KDTree(samples.points), reach, axes)
    rotation = frames.rotation[0]
    local = (corners - middle.points[0]) @ rotation
    inner = (samples.points - middle.points[0]) @ rotation
    radius = math.inf
    if frames.curvature[0, 0] * reach > 0.02 and frames.curvature[0, 0] > 1 / FLATTEST:

        def roughness(curvature: float) -> float:
            return float(np.var(_unrolled(inner, 1 / curvature)[:, 2]))

        guess = frames.curvature[0, 0]
        found = minimize_scalar(roughness, bounds=(0.5 * guess, 2 * guess), method="bounded")
        radius = max(float(f"{1 / found.x:.3g}"), least)
    height = float(np.mean(_unrolled(inner, radius)[:, 2]))
    local[..., 2] -= height
    flat = _unrolled(local, radius)
    triangles = shapely.polygons(flat[..., :2])
    outline = shapely.union_all(shapely.buffer(triangles, 1e-7, join_style="mitre"))
    if outline.geom_type != "Polygon" or outline.area < 0.9 * area.sum():
        raise SceneError(
            f"{name} does not unroll into one outline, since it folds over; paint smaller regions"
        )
    rounded = shapely.set_precision(outline.simplify(2 * _GRID), _GRID)
    outline = max(shapely.get_parts(rounded), key=shapely.area)  # rounding cuts slivers off
    x, y = shapely.get_coordinates(outline.centroid)[0].tolist()
    turn = np.eye(3)
    origin = np.array([x, y, 0.0])
    if math.isfinite(radius):
        c, q = math.cos(x / radius), math.sin(x / radius)
        turn = np.array([[c, 0.0, q], [0.0, 1.0, 0.0], [-q, 0.0, c]])
        origin = Film(radius, {}).placed(origin)
    outline = shapely.transform(outline, lambda xy: xy - [x, y])
    at = middle.points[0] + height * rotation[:, 2] + rotation @ origin
    pose = Pose.from_matrix(_matrix(rotation @ turn, at))
    return _Painted(outline, radius, pose, float(np.abs(flat[..., 2]).max()))


def _ring(ring: Any) -> list[list[float]]:
    return [[float(f"{x:.6g}"), float(f"{y:.6g}")] for x, y in list(ring.coords)[:-1]]


def _unrolled(points: Array, radius: float) -> Array:
    """Coordinates of the film of points in the frame of a patch [m], shape (..., 3)."""
    return points if math.isinf(radius) else Film(radius, {}).coordinates(points)


def _layout(
    names: Sequence[str], points: Array, frames: Fit, designs: Sequence[Design],
    samples: Samples, tree: KDTree, left_out: Mapping[str, str],
) -> SkinLayout:  # fmt: skip
    patches, deviation = {}, {}
    extents = {id(d): 0.5 * _extent(d) for d in designs}
    for name, point, rotation, design in zip(names, points, frames.rotation, designs, strict=True):
        patches[name] = (design, Pose.from_matrix(_matrix(rotation, point)))
        if len(samples.points):
            near = np.asarray(tree.query_ball_point(point, extents[id(design)]), dtype=int)
            near = near[samples.normals[near] @ rotation[:, 2] > 0.0]
            radius = math.inf if design.film is None else design.film.radius
            flat = _unrolled((samples.points[near] - point) @ rotation, radius)
            deviation[name] = float(np.abs(flat[:, 2]).max(initial=0.0))
    return SkinLayout(patches, deviation, dict(left_out))


def _designs(frames: Fit, patch: Pad | Design) -> list[Design]:
    """The design of each patch; discs that bulge nearly alike have one."""
    if isinstance(patch, Design):
        return [patch] * len(frames.rotation)
    size = patch.size
    step = 16 * _CLASS / size**2
    strongest = 1 / max(2 * patch.depth, 0.5 * size)
    curvature = np.clip(frames.curvature[:, 0], 0.0, strongest)
    curvature[curvature < 1 / FLATTEST] = 0.0
    number = np.rint(curvature / step).astype(int)
    made: dict[float, Design] = {}
    radius_of = {0: math.inf}
    for k in np.unique(number[number > 0]).tolist():
        radius_of[k] = float(f"{1 / curvature[number == k].mean():.2g}")
    for radius in set(radius_of[k] for k in number.tolist()):
        outline = {"shape": "disc", "radius": size / 2}
        made[radius] = pad_design(outline, size, radius, patch)
    return [made[radius_of[k]] for k in number.tolist()]


def _face_labels(mesh: LinkMesh, mask: NDArray[Any]) -> NDArray[np.int64]:
    """A label for each face, 0 where nothing is painted."""
    count = len(mask) if mask.ndim else -1
    if count not in (len(mesh.vertices), len(mesh.faces)):
        raise SceneError(
            f"mask has shape {mask.shape}; give a label for each of the {len(mesh.vertices)} "
            f"vertices or of the {len(mesh.faces)} faces"
        )
    if mask.ndim == 2 and mask.shape[1] in (3, 4):
        _, found, times = np.unique(mask, axis=0, return_inverse=True, return_counts=True)
        number = np.arange(1, len(times) + 1)
        number[times.argmax()] = 0
        labels = number[found.reshape(-1)]
    elif mask.ndim == 1 and mask.dtype.kind in "iub":
        labels = np.maximum(mask.astype(np.int64), 0)
    else:
        raise SceneError(
            f"mask has type {mask.dtype} and shape {mask.shape}; give whole numbers or booleans "
            "(n,), or colours (n, 3) or (n, 4)"
        )
    if count == len(mesh.vertices):
        a, b, c = labels[mesh.faces].T
        labels = np.where((a == b) | (a == c), a, np.where(b == c, b, 0))
    if not (labels > 0).any():
        raise SceneError("mask paints nothing; give some faces a label of 1 or more")
    return labels.astype(np.int64)


def _file_colours(link: object) -> NDArray[Any]:
    """Colours of the vertices or faces of a mesh file."""
    import trimesh

    if isinstance(link, str | Path):
        link = trimesh.load(link, force="mesh", process=False)
    visual = getattr(link, "visual", None)
    if visual is None or visual.kind not in ("vertex", "face"):
        raise SceneError("the mesh has no colours of vertices or faces; give a mask")
    return np.asarray(visual.face_colors if visual.kind == "face" else visual.vertex_colors)


def _within(places: Samples, region: Region | None) -> Samples:
    if region is None:
        return places
    if callable(region):
        inside = np.asarray(region(*places))
        if inside.shape != (len(places.points),) or inside.dtype != bool:
            raise SceneError(
                f"region returned {inside.dtype} of shape {inside.shape}; return a boolean for "
                f"each of the {len(places.points)} points"
            )
        return _chosen(places, inside)
    try:
        low, high = np.array(region, dtype=float).reshape(2, 3)
    except (TypeError, ValueError):
        raise SceneError(
            f"region is {region!r}; give the lower and the upper corner of a box, or a function"
        ) from None
    inside = (places.points >= low) & (places.points <= high)
    return _chosen(places, np.asarray(inside.all(axis=1)))


def _chosen(places: Samples, which: NDArray[np.bool_]) -> Samples:
    return Samples(places.points[which], places.normals[which])


def _matrix(rotation: Array, point: Array) -> Array:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, point
    return out


def _from_frames(path: Path, pattern: str) -> Taxels:
    rows = [
        (f"{path}, link {name!r}", name, [*pose.position, *pose.rotation[:, 2]])
        for name, pose in read_frames(path, pattern).items()
    ]
    return checked_taxels(rows, 1.0, str(path))


def _from_arrays(positions: ArrayLike, normals: ArrayLike | None, unit: str) -> Taxels:
    from capsense._validate import UNITS

    if unit not in UNITS:
        raise SceneError(f"unit is {unit!r}; give one of {', '.join(UNITS)}")
    if normals is None:
        raise SceneError("normals are missing; give one for each position, shape (n, 3)")
    p, n = np.asarray(positions, dtype=float), np.asarray(normals, dtype=float)
    if p.ndim != 2 or p.shape[1] != 3 or n.shape != p.shape:
        raise SceneError(f"positions and normals have shapes {p.shape} and {n.shape}; give (n, 3)")
    rows = [(f"taxel {k}", f"taxel_{k}", [*p[k], *n[k]]) for k in range(len(p))]
    return checked_taxels(rows, UNITS[unit], "taxels")


def _checked_patch(patch: Pad | Design | str | Path) -> tuple[Pad | Design, float]:
    """A pad or a design, and its size [m]."""
    if isinstance(patch, Pad):
        return patch, patch.size
    design = patch if isinstance(patch, Design) else load_design(patch)
    return design, _extent(design)


def _extent(design: Design) -> float:
    """Largest distance between corners of the electrodes' bounding box [m]."""
    bounds = np.array([e.surface.bounds for e in design.electrodes])
    across = bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)
    if len(design.electrodes) == 1:
        return float(across[:2].max())
    return float(np.hypot(*across[:2]))


def _checked_count(count: object, spacing: object) -> int | None:
    if count is None and spacing is None:
        raise SceneError("neither count nor spacing is given; give one of them")
    if count is None:
        return None
    number = as_number(count)
    if not (number.is_integer() and 1 <= number <= 10_000):
        raise SceneError(f"count is {count!r}; give a whole number from 1 to 10000")
    return int(number)
