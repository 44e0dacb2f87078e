"""A sensor for mjlab: ``CapacitanceCfg(name="skin", sites=("robot/pad",))`` among its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from mjlab.sensor import Sensor, SensorCfg

from capsense.adapters.mujoco_warp import CapacitiveSensors, find_sites
from capsense.adapters.parallel import SensorsByDesign
from capsense.adapters.record import ParallelData
from capsense.errors import SceneError
from capsense.simulator import DEFAULT_DESIGN

_WIDTH = 5e-4
"""Of the lines that electrodes are drawn by [m]."""
_SLACK = 1e-6
"""A world is due so much before its period is over [s], as in Isaac Lab."""


@dataclass
class CapacitanceCfg(SensorCfg):
    """Configuration of capacitive proximity sensors."""

    sites: tuple[str, ...] = ()
    """Names of the sites, with those of their entities: ``"robot/pad"``; or name patterns."""
    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file; for sites of several designs a dict of name
    patterns of sites and their designs, of which the first that fits decides."""
    update_period: float = 0.0
    """Time from one reading to the next [s]; by default they are read at every step."""
    history_length: int = 0
    """How many readings are kept in ``data.history``, the newest first."""
    readout: Any = None
    """A readout, a chip's name, or the path of a readout file, for codes and ages."""
    randomisation: Any = None
    """In what chips differ, drawn anew at a reset: a ``ReadoutRandomisation``."""
    seed: int | None = None
    """Of all random numbers of the chips; by default the readout's own."""
    debug_vis: bool = False
    """Whether electrodes are drawn in the viewer, coloured by their signals."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Others of :class:`~capsense.adapters.mujoco_warp.WarpOptions`: what is seen and what it is
    made of, and ``device``, ``preset``, ``budget``."""

    def build(self) -> CapacitanceOfSites:
        """Build the sensor."""
        return CapacitanceOfSites(self)


class CapacitanceOfSites(Sensor[Any]):
    """Readings of all sites in all worlds; ``data`` are tensors, by design if there are several.

    They are worked out when they are asked for, of the worlds that are due, once a step. Each world
    has a clock, which a reset sets to 0. ``sensors`` are those of MuJoCo Warp, by the names of
    their designs, after the scene has been initialised; their ``fleet`` changes materials. Sizes of
    geoms that mjlab draws for each world are followed.
    """

    def __init__(self, cfg: CapacitanceCfg) -> None:
        super().__init__()
        self.cfg = cfg
        self.sensors: SensorsByDesign[CapacitiveSensors] | None = None

    def edit_spec(self, scene_spec: Any, entities: dict[str, Any]) -> None:
        """Leave the model as it is: the sites are there."""

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        """Make a fleet for all worlds.

        Raises:
            SceneError: There is no such site, a pattern fits nothing, or nothing can be seen.
            DesignError: The design is wrong.
            ReadoutError: As by :meth:`Fleet.use_readout`.
        """
        cfg, self._state = self.cfg, getattr(data, "struct", data)
        if not cfg.update_period >= 0.0:
            raise SceneError(f"update_period is {cfg.update_period!r}; give a time in seconds")
        options = {
            "warp_model": getattr(model, "struct", model), **cfg.options,
            "history_length": cfg.history_length,
        }  # fmt: skip
        for name in ("readout", "randomisation", "seed"):
            if getattr(cfg, name) is not None:
                options[name] = getattr(cfg, name)
        names = [mj_model.site(k).name for k in find_sites(mj_model, cfg.sites)]
        self.sensors = SensorsByDesign.on_carriers(
            lambda chosen, design: CapacitiveSensors(
                mj_model, self._state, [names[k] for k in chosen], design, **options
            ),
            names, cfg.design,
        )  # fmt: skip
        worlds = self._state.qpos.shape[0]
        self._clock = torch.zeros(worlds, dtype=torch.float64, device=device)
        self._read_at = torch.full_like(self._clock, -torch.inf)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Restart chips and clocks; the worlds are read anew when they are asked for."""
        super().reset(env_ids)
        if self.sensors is None:
            return
        which = slice(None) if env_ids is None else env_ids
        mask = torch.zeros(len(self._clock), dtype=torch.bool, device=self._clock.device)
        mask[which] = True
        self._clock[mask], self._read_at[mask] = 0.0, -torch.inf
        self.sensors.reset(mask)

    def update(self, dt: float) -> None:
        """Let the clocks go on."""
        super().update(dt)
        if self.sensors is not None:
            self._clock += dt

    def _compute_data(self) -> ParallelData | dict[str, ParallelData]:
        assert self.sensors is not None
        due = self._clock - self._read_at + _SLACK >= self.cfg.update_period
        self.sensors.read(self._state, time=self._clock, environments=due)
        self._read_at = torch.where(due, self._clock, self._read_at)
        data = {name: each.data.torch() for name, each in self.sensors.items()}
        return data if isinstance(self.cfg.design, Mapping) else next(iter(data.values()))

    def debug_vis(self, visualizer: Any) -> None:
        """Draw the electrodes of the worlds that are shown."""
        if not self.cfg.debug_vis or self.sensors is None:
            return
        _ = self.data
        for name, sensors in self.sensors.items():
            for world in visualizer.get_env_indices(len(self._clock)):
                lines = zip(*sensors.electrode_lines([int(world)]), strict=True)
                for k, (start, end, colour) in enumerate(lines):
                    visualizer.add_cylinder(
                        start.astype(np.float32), end.astype(np.float32), _WIDTH,
                        (*colour.tolist(), 1.0), label=f"{self.cfg.name}/{name}/{world}/{k}",
                    )  # fmt: skip
