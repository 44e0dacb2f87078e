"""Stands for Isaac Lab 3, which needs a GPU: what ``capsense.adapters.isaac_lab`` uses of it.

The names, arguments and the order of calls are those of ``isaaclab.sensors.SensorBase`` and
``isaaclab_newton.physics.NewtonManager`` of Isaac Lab's main branch in November 2026. Behind the
manager is a real Newton model. Configuration classes are plain dataclasses here.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import warp as wp

MISSING: Any = "missing"


class NewtonManager:
    """Sites are asked for before the model is built, one of a label for each environment."""

    requests: dict[str, tuple[str, Any]] = {}  # noqa: RUF012
    model: Any = None
    state: Any = None
    sites: dict[str, tuple[int | None, list[list[int]] | None]] = {}  # noqa: RUF012

    @classmethod
    def register_site(cls, body_pattern: str | None, xform: Any) -> str:
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
        self.cfg = cfg.copy()
        self._is_initialized = False

    @property
    def device(self) -> str:
        return self._device

    def reset(self, env_ids: Any = None, env_mask: Any = None) -> None:
        mask = self._ALL_ENV_MASK if env_ids is None else self._mask
        if env_ids is not None:
            wp.to_torch(mask)[:] = False
            wp.to_torch(mask)[env_ids] = True
        wp.to_torch(self._is_outdated)[wp.to_torch(mask)] = True
        self._data_dirty = True

    def update(self, dt: float, force_recompute: bool = False) -> None:
        if not self._is_initialized:
            return
        self._data_dirty = True
        self._time += dt
        if self._time - self._read + 1e-6 >= self.cfg.update_period:
            self._is_outdated.fill_(True)
        if force_recompute:
            self._update_outdated_buffers(force_recompute=True)

    def _initialize_callback(self, event: Any) -> None:
        if not self._is_initialized:
            self._initialize_impl()
            self._is_initialized = True

    def _invalidate_initialize_callback(self, event: Any) -> None:
        self._is_initialized = False

    def _initialize_impl(self) -> None:
        self._device, self._num_envs = "cpu", NewtonManager.model.world_count
        self._ALL_ENV_MASK = wp.ones(self._num_envs, dtype=wp.bool, device="cpu")
        self._mask = wp.zeros(self._num_envs, dtype=wp.bool, device="cpu")
        self._is_outdated = wp.ones(self._num_envs, dtype=wp.bool, device="cpu")
        self._time = self._read = 0.0
        self._data_dirty = True

    def _update_outdated_buffers(self, force_recompute: bool = False) -> None:
        if not force_recompute and not self._data_dirty:
            return
        self._update_buffers_impl(self._is_outdated)
        if wp.to_torch(self._is_outdated).any():
            self._read = self._time
        self._is_outdated.zero_()
        self._data_dirty = False


def install() -> None:
    """Put the stub where the adapter looks for Isaac Lab."""
    names = {
        "isaaclab": {}, "isaaclab_newton": {},
        "isaaclab.sensors": {"SensorBase": SensorBase, "SensorBaseCfg": SensorBaseCfg},
        "isaaclab.utils": {"configclass": configclass},
        "isaaclab_newton.physics": {"NewtonManager": NewtonManager},
    }  # fmt: skip
    for name, members in names.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        sys.modules.setdefault(name, module)
