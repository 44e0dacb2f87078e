"""A sensor for Isaac Lab 3 on its Newton backend: ``CapacitiveSensorCfg(prim_path=…)``."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from isaaclab.sensors import SensorBase, SensorBaseCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import NewtonManager

from capsense.adapters.newton import SensorCapacitance
from capsense.errors import SceneError, warn_experimental
from capsense.simulator import DEFAULT_DESIGN


@dataclass
class CapacitiveSensorData:
    """What the sensors read, shape (environments, offsets, n, n)."""

    capacitance: torch.Tensor
    """Maxwell capacitance matrices [F]."""
    delta: torch.Tensor
    """Their change by the bodies [F]."""


class CapacitiveSensor(SensorBase):
    """Capacitive proximity sensors on a body of every environment.

    Registered as a site on Newton's model, as the sensors of Isaac Lab are. The readings are those
    of :class:`~capsense.adapters.newton.SensorCapacitance`, which is ``newton_sensor`` after the
    start of the simulation; its ``fleet`` changes materials and sizes.

    Raises:
        SceneError: The backend is not Newton, the path fits no body or several, or as by
            :class:`~capsense.adapters.newton.SensorCapacitance`.
    """

    cfg: CapacitiveSensorCfg

    def __init__(self, cfg: CapacitiveSensorCfg) -> None:
        super().__init__(cfg)
        warn_experimental("the sensor of Isaac Lab", "a stand-in and a real model of Newton")
        self._labels = [
            NewtonManager.register_site(cfg.prim_path, wp.transform(position, turn))
            for position, turn in cfg.offsets
        ]
        self.newton_sensor: SensorCapacitance | None = None
        self._data: CapacitiveSensorData | None = None

    @property
    def data(self) -> CapacitiveSensorData:
        """What the sensors read; those out of date are read now."""
        self._update_outdated_buffers()
        if self._data is None:
            raise SceneError(f"{self.cfg.prim_path!r} is not ready; call sim.reset() first")
        return self._data

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        model = NewtonManager.get_model()
        if model is None:
            raise SceneError("a capacitive sensor needs Isaac Lab's Newton backend")
        sites = NewtonManager.get_site_index_map()
        names = [glob.escape(model.shape_label[self._first(*sites[x])]) for x in self._labels]
        self.newton_sensor = SensorCapacitance(
            model, names, self.cfg.design, **self.cfg.options
        )  # fmt: skip
        self._data = None
        self._update_buffers_impl(self._ALL_ENV_MASK)

    def _first(self, world: int | None, each: Sequence[Sequence[int]] | None) -> int:
        """The site of the first environment."""
        if each is None and world is not None:
            return world
        counts = {len(sites) for sites in each or ()}
        if not each or counts != {1}:
            raise SceneError(
                f"{self.cfg.prim_path!r} fits {sorted(counts) or 'no'} bodies in an environment; "
                "give the path of one"
            )
        return each[0][0]

    def _update_buffers_impl(self, env_mask: Any) -> None:
        sensor = self.newton_sensor
        if sensor is None:
            return
        sensor.update(NewtonManager.get_state_0())
        found = [
            torch.from_dlpack(values).to(self.device, torch.float32)
            for values in (sensor.capacitance, sensor.delta)
        ]
        if self._data is None:
            self._data = CapacitiveSensorData(*(values.clone() for values in found))
        due = wp.to_torch(env_mask).view(-1, 1, 1, 1)
        for values, out in zip(found, (self._data.capacitance, self._data.delta), strict=True):
            torch.where(due, values, out, out=out)

    def _invalidate_initialize_callback(self, event: Any) -> None:
        super()._invalidate_initialize_callback(event)
        self.newton_sensor = None


@configclass
class CapacitiveSensorCfg(SensorBaseCfg):
    """Configuration of :class:`CapacitiveSensor`."""

    class_type: type = CapacitiveSensor
    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file."""
    offsets: list = field(
        default_factory=lambda: [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
    )  # fmt: skip
    """Frame of each sensor in the body's: position [m] and quaternion (x, y, z, w)."""
    options: dict = field(default_factory=dict)
    """Those of :class:`~capsense.adapters.parallel.FleetOptions`: what is seen and what it is made
    of, by the labels of Newton's shapes, and ``device``, ``preset``, ``budget``."""
