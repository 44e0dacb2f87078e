"""Sensors in all worlds of MuJoCo Warp: ``CapacitiveSensors(model, data, sites=["wrist"])``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.adapters.grounds import Ground
from capsense.adapters.meshes import primitive
from capsense.adapters.mujoco_depth import find_site
from capsense.adapters.mujoco_model import ModelReader
from capsense.adapters.parallel import (
    FleetOptions,
    ParallelSensors,
    WorldShape,
    as_numbers,
    from_matrices,
    matching,
)
from capsense.adapters.rules import Rules, split_rules
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.reading import FleetReading
from capsense.scene import Body, Pose, Shape
from capsense.simulator import DEFAULT_DESIGN

if TYPE_CHECKING:
    import mujoco


_SIZED = ("SPHERE", "CAPSULE", "CYLINDER", "ELLIPSOID", "BOX")
"""Types of geoms whose sizes say what they are."""


class WarpOptions(FleetOptions, total=False):
    """Keywords of :class:`CapacitiveSensors`."""

    groups: Collection[int] | None
    """See only geoms of these groups; default all. Of these, ``shapes`` chooses."""
    warp_model: Any
    """``mujoco_warp.Model``, whose ``geom_size`` is followed where worlds have sizes of their own;
    by default geoms are seen as they are in the MuJoCo model."""


class CapacitiveSensors(ParallelSensors):
    """Sensors on sites of a model, in all worlds of MuJoCo Warp.

    Planes and terrains are seen, flexes are not. Sizes of primitives are those of the model when
    the sensors are made, or with ``warp_model`` those that each world has at its last reset. Change
    :attr:`fleet` where worlds differ in materials.

    Args:
        model: The MuJoCo model that was put on the device.
        data: ``mujoco_warp.Data`` of some worlds.
        sites: Names of the sites, or name patterns; or that of one.
        design: A design, its name, or the path of its file, for all sites. For sites of several
            designs see :meth:`by_design`.
        options: What is seen and what it is made of, as for :func:`capsense.mujoco.attach`; and
            ``device``, ``preset``, ``budget``, ``readout``, ``randomisation``, ``seed``,
            ``history_length``, ``warp_model``. All are those of :class:`WarpOptions`.

    Raises:
        SceneError: There is no such site, a pattern fits nothing, or nothing can be seen.
        DesignError: The design is wrong.
        ReadoutError: As by :meth:`Fleet.use_readout`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: Any,
        sites: str | Sequence[str],
        design: Design | str | Path = DEFAULT_DESIGN,
        **options: Unpack[WarpOptions],
    ) -> None:
        rules, other = split_rules(options, WarpOptions)
        groups, self._model = other.pop("groups", None), other.pop("warp_model", None)
        reader = ModelReader(model, rules)
        geoms: list[int] = []
        parts: list[WorldShape] = []
        for geom in reader.seen(groups):
            solid = reader.solid(geom)
            if solid is None:
                continue
            body: Body | Ground
            if isinstance(solid.shape, Shape):
                body = Body(solid.shape, Pose(), solid.material, solid.tie.grounding)
            else:
                body = Ground(solid.shape, solid.material, solid.tie.grounding)
            geoms.append(geom)
            own = int(model.geom_bodyid[geom])
            link = own if own > 0 else -1
            parts.append(WorldShape((solid.label,), link, solid.tree, solid.tie, body))
        numbers = find_sites(model, [sites] if isinstance(sites, str) else sites)
        carriers = [(model.site(k).name, int(model.site_bodyid[k])) for k in numbers]
        device = data.geom_xpos.device
        super().__init__(
            parts, carriers, data.geom_xpos.shape[0], design, Rules(exclude_own=rules.exclude_own),
            device, other,
        )  # fmt: skip
        self._geom = [geoms[k] for k in self.chosen]
        self._geoms = as_numbers(self._geom, device)
        self._numbers = as_numbers(numbers, device)
        kinds = [mujoco_kind(model, geom) for geom in self._geom]
        self._kinds = {k: kind for k, kind in enumerate(kinds) if kind in _SIZED}
        self._sizes = np.broadcast_to(
            model.geom_size[self._geom], (self.fleet.count, len(self._geom), 3)
        ).astype(np.float32)

    def _resized(self) -> Iterator[tuple[int, NDArray[np.integer], list[Body]]]:
        if self._model is None:
            return
        now = np.broadcast_to(self._model.geom_size.numpy()[:, self._geom], self._sizes.shape)
        for place, kind in self._kinds.items():
            rows = np.flatnonzero((now[:, place] != self._sizes[:, place]).any(axis=1))
            if len(rows):
                yield place, rows, self._bodies(place, kind, now[rows, place])
        self._sizes = now.copy()

    def _bodies(self, place: int, kind: str, sizes: NDArray[Any]) -> list[Body]:
        """Bodies of some sizes in a place; alike ones are one."""
        made: dict[tuple[float, ...], Body] = {}
        out = []
        for size in map(tuple, sizes.tolist()):
            if size not in made:
                shape = primitive(kind, size)
                assert shape is not None
                made[size] = self._like(place, shape)
            out.append(made[size])
        return out

    def read(self, data: Any, *, time: Any = None, environments: Any = None) -> FleetReading:
        """Return the readings of all worlds, shape (worlds, sites, …).

        Args:
            data: ``mujoco_warp.Data`` after ``forward`` or ``step``.
            time: As of :meth:`Fleet.step`, where a readout is used. ``data.time`` has each world's
                own.
            environments: Which worlds are solved, as of :meth:`Fleet.step`; all by default.

        Raises:
            ReadoutError: As by :meth:`Fleet.step`.
            SolveError: As by :meth:`Fleet.step`.
        """
        for position, matrix, number, out in (
            (data.geom_xpos, data.geom_xmat, self._geoms, self._poses),
            (data.site_xpos, data.site_xmat, self._numbers, self._frames),
        ):
            wp.launch(
                from_matrices, dim=out.shape, inputs=[position, matrix, number, out],
                device=out.device,
            )  # fmt: skip
        return self._read(time, environments)

    def draw(self, scene: Any, world: int = 0, width: float = 3.0) -> int:
        """Draw the electrodes of a world into a scene of MuJoCo, such as ``viewer.user_scn``.

        They are drawn where the sensors were at the last reading, coloured by their signals.

        Args:
            scene: ``mujoco.MjvScene``; lines are added to its geoms as far as there is room.
            world: Number of the world.
            width: Width of the lines [pixels].

        Returns:
            How many lines were added.

        Raises:
            SceneError: There is no such world.
        """
        import mujoco

        before = scene.ngeom
        for start, end, colour in zip(*self.electrode_lines([world]), strict=True):
            if scene.ngeom >= scene.maxgeom:
                break
            geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_LINE
            rgba = np.array([*colour, 1.0], np.float32)
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
            mujoco.mjv_connector(geom, kind, width, start, end)
            scene.ngeom += 1
        return int(scene.ngeom - before)


def mujoco_kind(model: mujoco.MjModel, geom: int) -> str:
    """The type of a geom, without its prefix: ``"SPHERE"``."""
    import mujoco

    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_")


def find_sites(model: mujoco.MjModel, patterns: Sequence[str]) -> list[int]:
    """Numbers of the sites of some names or name patterns.

    Raises:
        SceneError: There is no such site.
    """
    names = [model.site(k).name for k in range(model.nsite)]
    out: dict[int, None] = {}
    for pattern in patterns:
        if pattern in names or not any(c in "*?[" for c in pattern):
            out[find_site(model, pattern)] = None
        else:
            out.update(dict.fromkeys(matching(names, pattern, "site")))
    if not out:
        raise SceneError("sites is empty; give the names of some sites")
    return list(out)
