"""Sensors in all worlds of MuJoCo Warp: ``CapacitiveSensors(model, data, sites=["wrist"])``."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import warp as wp

from capsense.adapters.mujoco_depth import find_site
from capsense.adapters.mujoco_model import ModelReader
from capsense.adapters.parallel import (
    FleetOptions,
    ParallelSensors,
    WorldShape,
    as_numbers,
    from_matrices,
    warn_left_out,
)
from capsense.adapters.rules import Rules, split_rules
from capsense.design.model import Design
from capsense.reading import FleetReading
from capsense.scene import Body, Pose, Shape
from capsense.simulator import DEFAULT_DESIGN

if TYPE_CHECKING:
    import mujoco


class WarpOptions(FleetOptions, total=False):
    """Keywords of :class:`CapacitiveSensors`."""

    groups: Collection[int] | None
    """See only geoms of these groups; default all."""


class CapacitiveSensors(ParallelSensors):
    """Sensors on sites of a model, in all worlds of MuJoCo Warp.

    Geoms are seen as they are in the model when the sensors are made, the same in all worlds;
    change :attr:`fleet` where worlds differ. Planes, terrains and flexes are not seen.

    Args:
        model: The MuJoCo model that was put on the device.
        data: ``mujoco_warp.Data`` of some worlds.
        sites: Names of the sites, or that of one.
        design: A design, its name, or the path of its file, for all sites.
        options: What is seen and what it is made of, as for :func:`capsense.mujoco.attach`; and
            ``device``, ``preset``, ``budget``. All are those of :class:`WarpOptions`.

    Raises:
        SceneError: There is no such site, a pattern fits nothing, or nothing can be seen.
        DesignError: The design is wrong.
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
        groups = other.pop("groups", None)
        reader = ModelReader(model, rules)
        geoms: list[int] = []
        parts: list[WorldShape] = []
        flat: list[str] = []
        for geom in range(model.ngeom):
            if groups is not None and int(model.geom_group[geom]) not in groups:
                continue
            solid = reader.solid(geom)
            if solid is None:
                continue
            if not isinstance(solid.shape, Shape):
                flat.append(solid.label)
                continue
            body = Body(solid.shape, Pose(), solid.material, solid.tie.grounding)
            geoms.append(geom)
            own = int(model.geom_bodyid[geom])
            root = int(model.body_rootid[own])
            link, tree = (number if number > 0 else -1 for number in (own, root))
            parts.append(WorldShape((solid.label,), link, tree, solid.tie.owner, body))
        warn_left_out(flat, "a fleet sees no planes and terrains")
        sites = [sites] if isinstance(sites, str) else list(sites)
        numbers = [find_site(model, site) for site in sites]
        carriers = [
            (name, int(model.site_bodyid[k])) for name, k in zip(sites, numbers, strict=True)
        ]
        device = data.geom_xpos.device
        super().__init__(
            parts, carriers, data.geom_xpos.shape[0], design, Rules(exclude_own=rules.exclude_own),
            device, other,
        )  # fmt: skip
        self._geoms = as_numbers(geoms, device)
        self._numbers = as_numbers(numbers, device)

    def read(self, data: Any, *, time: float | None = None) -> FleetReading:
        """Return the readings of all worlds, shape (worlds, sites, …).

        Args:
            data: ``mujoco_warp.Data`` after ``forward`` or ``step``.
            time: As of :meth:`Fleet.step`, where a readout is used.

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
        return self._read(time)
