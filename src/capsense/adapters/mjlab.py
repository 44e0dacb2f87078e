"""A sensor for mjlab: ``CapacitanceCfg(name="skin", sites=("robot/pad",))`` among its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from mjlab.sensor import Sensor, SensorCfg

from capsense.adapters.mujoco_warp import CapacitiveSensors
from capsense.simulator import DEFAULT_DESIGN


@dataclass
class CapacitanceCfg(SensorCfg):
    """Configuration of capacitive proximity sensors of one design."""

    sites: tuple[str, ...] = ()
    """Names of the sites, with those of their entities: ``"robot/pad"``."""
    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Those of :class:`~capsense.adapters.mujoco_warp.WarpOptions`."""

    def build(self) -> CapacitanceOfSites:
        """Build the sensor."""
        return CapacitanceOfSites(self)


class CapacitanceOfSites(Sensor[torch.Tensor]):
    """Change of the Maxwell matrices by the bodies [F], shape (worlds, sites, n, n), as ``data``.

    It is worked out when it is asked for, once a step. ``sensors`` are those of MuJoCo Warp, after
    the scene has been initialised; their ``fleet`` changes sizes and materials.
    """

    def __init__(self, cfg: CapacitanceCfg) -> None:
        super().__init__()
        self.cfg = cfg
        self.sensors: CapacitiveSensors | None = None

    def edit_spec(self, scene_spec: Any, entities: dict[str, Any]) -> None:
        """Leave the model as it is: the sites are there."""

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        """Make a fleet for all worlds.

        Raises:
            SceneError: There is no such site, a pattern fits nothing, or nothing can be seen.
            DesignError: The design is wrong.
        """
        self._state, self._device = getattr(data, "struct", data), device
        self.sensors = CapacitiveSensors(
            mj_model, self._state, self.cfg.sites, self.cfg.design, **self.cfg.options
        )

    def _compute_data(self) -> torch.Tensor:
        assert self.sensors is not None
        delta = self.sensors.read(self._state).delta
        return torch.from_dlpack(delta).to(self._device, torch.float32, copy=True)
