"""Stands for Isaac Lab 3, which needs a GPU: what ``capsense.adapters.isaac_lab`` uses of it.

Names, arguments and the order of calls were compared with these files of the public repository
isaac-sim/IsaacLab, each at a commit of 2026, and with no released tag:

- ``isaaclab/sensors/sensor_base.py`` and ``isaaclab_newton/physics/newton_manager.py`` at
  001515cbcc9e, where the methods for sites have the prefix ``cl_``;
- ``isaaclab_newton/sensors/imu/imu.py`` at 1d4899f16306, which calls them without the prefix;
- ``isaaclab/sensors/kernels.py`` at 153a1e5c2ea3;
- ``isaaclab/markers/vis_marker_registry.py`` at 25d744b82ce7 and
  ``isaaclab/markers/newton_visualization_markers.py`` at 0bbc9347e27a.

What the tests rely on: timestamps in single precision and masks of what is outdated for each
environment; ``reset`` clears the mask, so that data are read anew after the next ``update`` only;
``update`` reads at once while it draws; markers are blocks of one for each environment, with
quaternions (x, y, z, w). Behind the manager is a real Newton model. Configuration classes are plain
dataclasses here.
"""

from __future__ import annotations

import inspect
import sys
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import torch
import warp as wp

MISSING: Any = "missing"


class NewtonManager:
    """Sites are asked for before the model is built, one of a label for each environment."""

    requests: dict[str, tuple[str, Any]] = {}  # noqa: RUF012
    model: Any = None
    state: Any = None
    sites: dict[str, tuple[int | None, list[list[int]] | None]] = {}  # noqa: RUF012

    @classmethod
    def register_site(cls, body_pattern: str | None, xform: Any, *, per_world: bool = False) -> str:
        label = f"site_{len(cls.requests)}"
        cls.requests[label] = (body_pattern or "", xform)
        return label

    @classmethod
    def get_site_index_map(cls) -> dict[str, tuple[int | None, list[list[int]] | None]]:
        return cls.sites

    @classmethod
    def get_model(cls) -> Any:
        return cls.model

    @classmethod
    def get_state_0(cls) -> Any:
        return cls.state


def configclass(cls: type) -> type:
    def validate(self: Any) -> None:
        missing = [f.name for f in fields(self) if getattr(self, f.name) is MISSING]
        assert not missing, f"missing: {missing}"

    cls.validate, cls.copy = validate, replace  # type: ignore[attr-defined]
    return dataclass(cls)


class VisMarkerRegistry:
    """Callbacks before every picture."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Any] = {}

    def add_debug_vis_callback(self, owner: Any) -> str:
        name = f"visualization_marker:{type(owner).__name__}:{id(owner)}"
        self.callbacks[name] = owner._debug_vis_callback
        return name

    def clear_debug_vis_callback(self, owner: Any) -> None:
        self.callbacks.pop(getattr(owner, "_debug_vis_handle", None), None)
        owner._debug_vis_handle = None

    def dispatch_callbacks(self, event: Any = None) -> None:
        for callback in list(self.callbacks.values()):
            callback(event)


class SimulationContext:
    """The one simulation that there is."""

    device = "cpu"
    one: Any = None

    def __init__(self) -> None:
        self.vis_marker_registry = VisMarkerRegistry()
        SimulationContext.one = self

    @classmethod
    def instance(cls) -> Any:
        return cls.one


@dataclass
class PreviewSurfaceCfg:
    diffuse_color: tuple[float, float, float] = (0.18, 0.18, 0.18)


@dataclass
class CuboidCfg:
    size: tuple[float, float, float] = MISSING
    visual_material: Any = None


@dataclass
class VisualizationMarkersCfg:
    prim_path: str = MISSING
    markers: dict[str, Any] = MISSING


class VisualizationMarkers:
    """Keeps what it was told to show."""

    def __init__(self, cfg: VisualizationMarkersCfg) -> None:
        self.cfg, self.visible, self.shown = cfg, True, {}

    def set_visibility(self, visible: bool) -> None:
        self.visible = visible

    def visualize(
        self, translations: Any = None, orientations: Any = None, scales: Any = None,
        marker_indices: Any = None,
    ) -> None:  # fmt: skip
        self.shown = {
            "translations": translations, "orientations": orientations, "scales": scales,
            "marker_indices": marker_indices,
        }  # fmt: skip
        assert {len(values) for values in self.shown.values()} == {len(translations)}
        assert marker_indices.max() < len(self.cfg.markers)


@configclass
class SensorBaseCfg:
    class_type: type = MISSING
    prim_path: str = MISSING
    update_period: float = 0.0
    debug_vis: bool = False


class SensorBase:
    """Buffers are filled when ``data`` is read, where the environment is out of date."""

    def __init__(self, cfg: Any) -> None:
        cfg.validate()
        cfg.prim_path = cfg.prim_path.replace("{ENV_REGEX_NS}", "/World/envs/env_.*")
        self.cfg = cfg.copy()
        self._is_initialized = self._is_visualizing = False
        self._debug_vis_handle = None
        self.set_debug_vis(self.cfg.debug_vis)

    @property
    def device(self) -> str:
        return self._device

    @property
    def num_instances(self) -> int:
        return self._num_envs

    @property
    def has_debug_vis_implementation(self) -> bool:
        return "NotImplementedError" not in inspect.getsource(self._set_debug_vis_impl)

    def set_debug_vis(self, debug_vis: bool) -> bool:
        if not self.has_debug_vis_implementation:
            return False
        self._set_debug_vis_impl(debug_vis)
        self._is_visualizing = debug_vis
        context = SimulationContext.instance()
        if context is None:
            return True
        if not debug_vis:
            context.vis_marker_registry.clear_debug_vis_callback(self)
        elif self._debug_vis_handle is None:
            self._debug_vis_handle = context.vis_marker_registry.add_debug_vis_callback(self)
        return True

    def reset(self, env_ids: Any = None, env_mask: Any = None) -> None:
        mask = wp.to_torch(self._resolve_indices_and_mask(env_ids, env_mask))
        for values in (self._timestamp, self._timestamp_last_update, self._is_outdated):
            wp.to_torch(values)[mask] = 0
        self._data_dirty = True

    def update(self, dt: float, force_recompute: bool = False) -> None:
        if not self._is_initialized:
            return
        self._data_dirty = True
        now, last = (wp.to_torch(x) for x in (self._timestamp, self._timestamp_last_update))
        now += dt
        wp.to_torch(self._is_outdated)[now - last + 1e-6 >= self.cfg.update_period] = True
        if force_recompute or self._is_visualizing:
            self._update_outdated_buffers(force_recompute=force_recompute)

    def _initialize_callback(self, event: Any) -> None:
        if not self._is_initialized:
            self._initialize_impl()
            self._is_initialized = True

    def _invalidate_initialize_callback(self, event: Any) -> None:
        self._is_initialized = False

    def _initialize_impl(self) -> None:
        self._device = SimulationContext.instance().device
        self._num_envs = NewtonManager.model.world_count
        count, device = self._num_envs, self._device
        self._ALL_ENV_MASK = wp.ones(count, dtype=wp.bool, device=device)
        self._reset_mask = wp.zeros(count, dtype=wp.bool, device=device)
        self._is_outdated = wp.ones(count, dtype=wp.bool, device=device)
        self._timestamp = wp.zeros(count, dtype=wp.float32, device=device)
        self._timestamp_last_update = wp.zeros_like(self._timestamp)
        self._data_dirty = True

    def _update_outdated_buffers(self, force_recompute: bool = False) -> None:
        if not force_recompute and not self._data_dirty:
            return
        self._update_buffers_impl(self._is_outdated)
        outdated = wp.to_torch(self._is_outdated)
        last = wp.to_torch(self._timestamp_last_update)
        last[:] = torch.where(outdated, wp.to_torch(self._timestamp), last)
        outdated[:] = False
        self._data_dirty = False

    def _resolve_indices_and_mask(self, env_ids: Any = None, env_mask: Any = None) -> Any:
        if (env_ids is None or env_ids == slice(None)) and env_mask is None:
            return self._ALL_ENV_MASK
        if env_mask is not None:
            return env_mask
        self._reset_mask.zero_()
        wp.to_torch(self._reset_mask)[env_ids] = True
        return self._reset_mask

    def _set_debug_vis_impl(self, debug_vis: bool) -> None:
        raise NotImplementedError

    def _debug_vis_callback(self, event: Any) -> None:
        raise NotImplementedError


def install() -> None:
    """Put the stub where the adapter looks for Isaac Lab."""
    names = {
        "isaaclab": {}, "isaaclab_newton": {},
        "isaaclab.sensors": {"SensorBase": SensorBase, "SensorBaseCfg": SensorBaseCfg},
        "isaaclab.sim": {
            "CuboidCfg": CuboidCfg, "PreviewSurfaceCfg": PreviewSurfaceCfg,
            "SimulationContext": SimulationContext,
        },
        "isaaclab.markers": {
            "VisualizationMarkers": VisualizationMarkers,
            "VisualizationMarkersCfg": VisualizationMarkersCfg,
        },
        "isaaclab.utils": {"configclass": configclass},
        "isaaclab_newton.physics": {"NewtonManager": NewtonManager},
    }  # fmt: skip
    for name, members in names.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        known = sys.modules.setdefault(name, module)
        parent, _, own = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], own, known)
