"""A sensor for Isaac Lab 3 on its Newton backend: ``CapacitiveSensorCfg(prim_path=…)``."""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import isaaclab.sim as sim_utils
import numpy as np
import torch
import warp as wp
from isaaclab.markers import VisualizationMarkers, VisualizationMarkersCfg
from isaaclab.sensors import SensorBase, SensorBaseCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import NewtonManager

from capsense._style import signal_colours
from capsense.adapters.newton import SensorCapacitance
from capsense.adapters.parallel import SensorsByDesign
from capsense.adapters.record import ParallelData
from capsense.errors import SceneError, warn_experimental
from capsense.simulator import DEFAULT_DESIGN

_SHADES = 8
"""Colours that electrodes are drawn in, one marker each."""
_WIDTH = 5e-4
"""Of the lines that electrodes are drawn by [m]."""


class CapacitiveSensor(SensorBase):
    """Capacitive proximity sensors on bodies of every environment.

    Registered as sites on Newton's model, as the sensors of Isaac Lab are: one on each body that
    ``prim_path`` fits, and for each of ``offsets``. The readings are those of
    :class:`~capsense.adapters.newton.SensorCapacitance`, by the names of their designs in
    :attr:`newton_sensors` after the start of the simulation; their ``fleet`` changes materials.

    Environments that are due are solved, when ``data`` is read or the electrodes are drawn. Each
    has a clock, which :meth:`reset` sets to 0; chips convert along a straight line between two
    readings. The backend calls :meth:`reset` before it draws sizes anew, and the next reading takes
    them over.

    Raises:
        SceneError: The backend is not Newton, the path fits no body or not as many in each
            environment, or as by :class:`~capsense.adapters.newton.SensorCapacitance`.
        ReadoutError: As by :meth:`Fleet.use_readout`.
    """

    cfg: CapacitiveSensorCfg

    def __init__(self, cfg: CapacitiveSensorCfg) -> None:
        self.newton_sensors: SensorsByDesign[SensorCapacitance] | None = None
        super().__init__(cfg)
        warn_experimental("the sensor of Isaac Lab", "a stand-in and a real model of Newton")
        register = _method("register_site")
        self._labels = [
            register(self.cfg.prim_path, wp.transform(position, turn))
            for position, turn in cfg.offsets
        ]

    @property
    def data(self) -> ParallelData | dict[str, ParallelData]:
        """What the sensors read, as tensors of PyTorch; those out of date are read now.

        Shapes are (environments, sensors, …): all bodies of the first offset, then those of the
        next. By the names of the designs, where ``cfg.design`` is a dict.
        """
        self._update_outdated_buffers()
        sensors = self._ready()
        data = {name: each.data.torch() for name, each in sensors.items()}
        return data if isinstance(self.cfg.design, Mapping) else next(iter(data.values()))

    @property
    def sensor_names(self) -> dict[str, tuple[str, ...]]:
        """Labels of the bodies that carry the sensors, in order, by the names of the designs."""
        return {name: each.carriers for name, each in self._ready().items()}

    def reset(self, env_ids: Sequence[int] | None = None, env_mask: Any = None) -> None:
        """Restart chips and clocks, and clear the data, which are read anew after the next step."""
        mask = self._resolve_indices_and_mask(env_ids, env_mask)
        super().reset(None, mask)
        if self.newton_sensors is not None:
            self._clock[wp.to_torch(mask)] = 0.0
            self.newton_sensors.reset(mask)

    def update(self, dt: float, force_recompute: bool = False) -> None:
        """Let the clocks go on."""
        if self._is_initialized:
            self._clock += dt
        super().update(dt, force_recompute)

    def _ready(self) -> SensorsByDesign[SensorCapacitance]:
        if self.newton_sensors is None:
            raise SceneError(f"{self.cfg.prim_path!r} is not ready; call sim.reset() first")
        return self.newton_sensors

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        model = NewtonManager.get_model()
        if model is None:
            raise SceneError("a capacitive sensor needs Isaac Lab's Newton backend")
        # in double precision, which the timestamps of the base class have not
        self._clock = torch.zeros(self._num_envs, dtype=torch.float64, device=self.device)
        sites = _method("get_site_index_map")()
        numbers = [k for label in self._labels for k in self._of_first(*sites[label])]
        bodies, options = model.shape_body.numpy(), dict(self.cfg.options)
        options["history_length"] = self.cfg.history_length
        for name in ("readout", "randomisation", "seed"):
            if getattr(self.cfg, name) is not None:
                options[name] = getattr(self.cfg, name)
        labels = [model.body_label[int(bodies[k])] if bodies[k] >= 0 else "world" for k in numbers]
        design = self.cfg.design
        self.newton_sensors = SensorsByDesign.on_carriers(
            lambda chosen, one: SensorCapacitance(
                model, [glob.escape(model.shape_label[numbers[k]]) for k in chosen], one, **options
            ),
            labels, design,
        )  # fmt: skip

    def _of_first(self, world: int | None, each: Sequence[Sequence[int]] | None) -> list[int]:
        """The sites of the first environment."""
        if each is None and world is not None:
            return [world]
        counts = sorted({len(sites) for sites in each or ()})
        if not each or len(counts) != 1 or not counts[0]:
            raise SceneError(
                f"{self.cfg.prim_path!r} fits {counts or 'no'} bodies in an environment; give a "
                "path that fits as many in each, and one or more"
            )
        return list(each[0])

    def _update_buffers_impl(self, env_mask: Any) -> None:
        if self.newton_sensors is not None:
            state = NewtonManager.get_state_0()
            self.newton_sensors.read(state, time=self._clock, environments=env_mask)

    def _set_debug_vis_impl(self, debug_vis: bool) -> None:
        if debug_vis and not hasattr(self, "_markers"):
            self._markers = VisualizationMarkers(self.cfg.visualizer_cfg)
        if hasattr(self, "_markers"):
            self._markers.set_visibility(debug_vis)

    def _debug_vis_callback(self, event: Any) -> None:
        if self.newton_sensors is None:
            return
        self._update_outdated_buffers()
        drawn = [sensors.electrode_lines() for sensors in self.newton_sensors.values()]
        # block by block, one for each line of an environment, as the viewers choose environments
        starts, ends, colours = (
            np.concatenate(
                [x[k].reshape(self._num_envs, -1, 3).transpose(1, 0, 2) for x in drawn]
            ).reshape(-1, 3)
            for k in range(3)
        )
        along = ends - starts
        length = np.linalg.norm(along, axis=1)
        scale = np.stack([length, np.full(len(length), _WIDTH), np.full(len(length), _WIDTH)], 1)
        shade = _shade(colours)
        middle, turn = 0.5 * (starts + ends), _turns(along / length[:, None])
        self._markers.visualize(
            *(torch.tensor(v, dtype=torch.float32, device=self.device) for v in (middle, turn)),
            scales=torch.tensor(scale, dtype=torch.float32, device=self.device),
            marker_indices=torch.tensor(shade, device=self.device),
        )

    def _invalidate_initialize_callback(self, event: Any) -> None:
        super()._invalidate_initialize_callback(event)
        self.newton_sensors = None


def _method(name: str) -> Any:
    """A method of the manager, which has a prefix in some versions of Isaac Lab 3."""
    return getattr(NewtonManager, name, None) or getattr(NewtonManager, f"cl_{name}")


def _shade(colours: Any) -> Any:
    """Numbers of the markers that are nearest to colours, shape (k,)."""
    loud = signal_colours(np.linspace(0.0, 1.0, _SHADES)) / 255.0
    return np.argmin(((colours[:, None] - loud) ** 2).sum(axis=2), axis=1)


def _turns(way: Any) -> Any:
    """Quaternions (x, y, z, w) that turn the x axis to directions of length 1, (k, 3)."""
    x = np.array([1.0, 0.0, 0.0])
    w = 1.0 + way @ x
    turn = np.concatenate([np.cross(x, way), w[:, None]], axis=1)
    turn[w < 1e-9] = 0.0, 0.0, 1.0, 0.0
    return turn / np.linalg.norm(turn, axis=1, keepdims=True)


def electrode_markers(prim_path: str = "/Visuals/Electrodes") -> VisualizationMarkersCfg:
    """Boxes of the colours that electrodes are drawn in, from quiet to loud."""
    colours = signal_colours(np.linspace(0.0, 1.0, _SHADES)) / 255.0
    return VisualizationMarkersCfg(
        prim_path=prim_path,
        markers={
            f"signal_{k}": sim_utils.CuboidCfg(
                size=(1.0, 1.0, 1.0),
                visual_material=sim_utils.PreviewSurfaceCfg(diffuse_color=tuple(colour)),
            )
            for k, colour in enumerate(colours.tolist())
        },
    )


@configclass
class CapacitiveSensorCfg(SensorBaseCfg):
    """Configuration of :class:`CapacitiveSensor`."""

    class_type: type = CapacitiveSensor
    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file; for bodies of several designs a dict of name
    patterns of the bodies' labels and their designs, of which the first that fits decides."""
    offsets: list = field(
        default_factory=lambda: [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
    )  # fmt: skip
    """Frame of each sensor in the body's: position [m] and quaternion (x, y, z, w)."""
    history_length: int = 0
    """How many readings are kept in ``data.history``, the newest first."""
    readout: Any = None
    """A readout, a chip's name, or the path of a readout file, for codes and ages."""
    randomisation: Any = None
    """In what chips differ, drawn anew at a reset: a ``ReadoutRandomisation``."""
    seed: int | None = None
    """Of all random numbers of the chips; by default the readout's own."""
    options: dict = field(default_factory=dict)
    """Others of :class:`~capsense.adapters.parallel.FleetOptions`: what is seen and what it is made
    of, by the labels of Newton's shapes, and ``device``, ``preset``, ``budget``."""
    visualizer_cfg: VisualizationMarkersCfg = field(default_factory=electrode_markers)
    """What electrodes are drawn by with ``debug_vis``."""
