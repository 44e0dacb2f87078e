"""CapSense: real-time simulation of capacitive proximity sensors for robots.

The public names are listed in ``__all__``. They are imported at first use, so ``import capsense``
itself is light.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capsense._kernel_cache import ensure_place

if TYPE_CHECKING:
    from capsense import humans
    from capsense.adapters import assistive_gym, coppeliasim, mujoco, pybullet
    from capsense.design.loader import available_designs, load_design
    from capsense.design.model import Design
    from capsense.errors import (
        AdapterError,
        BatchError,
        CapSenseError,
        DesignError,
        FieldError,
        MeshError,
        MissingDependencyError,
        ProtocolError,
        ReadoutError,
        RecordingError,
        ScenarioError,
        SceneError,
        ServerError,
        SkinError,
        SolveError,
    )
    from capsense.fleet.fleet import Fleet, FleetReading
    from capsense.reading import Reading
    from capsense.readout.config import load_readout
    from capsense.readout.counts import Counts
    from capsense.readout.readout import Readout
    from capsense.recording.reader import open_recording
    from capsense.recording.recorder import Recorder, record
    from capsense.recording.replay import replay
    from capsense.scenario import Scenario, load_scenario
    from capsense.scene.body import Body
    from capsense.scene.camera import OrthographicCamera, PerspectiveCamera
    from capsense.scene.deformable import DeformableSurface
    from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity
    from capsense.scene.layers import Layers
    from capsense.scene.materials import MATERIALS, Material
    from capsense.scene.mesh_shape import TriMesh
    from capsense.scene.point_surface import point_surface
    from capsense.scene.pose import Pose
    from capsense.scene.raster import render_depth
    from capsense.scene.scene import Scene
    from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
    from capsense.simulator import Simulator
    from capsense.skin import Skin
    from capsense.viewer.show import show

    __version__: str

__all__ = [
    "MATERIALS",
    "AdapterError",
    "BatchError",
    "Body",
    "Box",
    "CapSenseError",
    "Capsule",
    "Counts",
    "Cylinder",
    "DeformableSurface",
    "DepthFrame",
    "Design",
    "DesignError",
    "Ellipsoid",
    "FieldError",
    "Fleet",
    "FleetReading",
    "Layers",
    "Material",
    "MeshError",
    "MissingDependencyError",
    "OrthographicCamera",
    "PerspectiveCamera",
    "Pose",
    "ProtocolError",
    "Reading",
    "Readout",
    "ReadoutError",
    "Recorder",
    "RecordingError",
    "Scenario",
    "ScenarioError",
    "Scene",
    "SceneError",
    "ServerError",
    "Simulator",
    "Skin",
    "SkinError",
    "SolveError",
    "Sphere",
    "TriMesh",
    "__version__",
    "assistive_gym",
    "available_designs",
    "coppeliasim",
    "decode_permittivity",
    "encode_permittivity",
    "humans",
    "load_design",
    "load_readout",
    "load_scenario",
    "mujoco",
    "open_recording",
    "point_surface",
    "pybullet",
    "record",
    "render_depth",
    "replay",
    "show",
]

_HOMES = {
    "capsense.design.loader": ("available_designs", "load_design"),
    "capsense.design.model": ("Design",),
    "capsense.errors": (
        "BatchError",
        "CapSenseError",
        "DesignError",
        "FieldError",
        "MeshError",
        "MissingDependencyError",
        "ProtocolError",
        "ReadoutError",
        "RecordingError",
        "ScenarioError",
        "SceneError",
        "ServerError",
        "AdapterError",
        "SkinError",
        "SolveError",
    ),
    "capsense.readout.config": ("load_readout",),
    "capsense.readout.counts": ("Counts",),
    "capsense.readout.readout": ("Readout",),
    "capsense.reading": ("Reading",),
    "capsense.recording.reader": ("open_recording",),
    "capsense.recording.recorder": ("Recorder", "record"),
    "capsense.recording.replay": ("replay",),
    "capsense.scenario": ("Scenario", "load_scenario"),
    "capsense.scene.body": ("Body",),
    "capsense.scene.camera": ("OrthographicCamera", "PerspectiveCamera"),
    "capsense.scene.deformable": ("DeformableSurface",),
    "capsense.scene.depth": ("DepthFrame", "decode_permittivity", "encode_permittivity"),
    "capsense.scene.layers": ("Layers",),
    "capsense.scene.materials": ("MATERIALS", "Material"),
    "capsense.scene.mesh_shape": ("TriMesh",),
    "capsense.scene.point_surface": ("point_surface",),
    "capsense.scene.pose": ("Pose",),
    "capsense.scene.raster": ("render_depth",),
    "capsense.scene.scene": ("Scene",),
    "capsense.scene.shapes": ("Box", "Capsule", "Cylinder", "Ellipsoid", "Sphere"),
    "capsense.simulator": ("Simulator",),
    "capsense.fleet.fleet": ("Fleet", "FleetReading"),
    "capsense.viewer.show": ("show",),
    "capsense.skin": ("Skin",),
}
_SUBMODULES = {
    "assistive_gym": "capsense.adapters.assistive_gym",
    "coppeliasim": "capsense.adapters.coppeliasim",
    "humans": "capsense.humans",
    "mujoco": "capsense.adapters.mujoco",
    "pybullet": "capsense.adapters.pybullet",
}
ensure_place(Path(__file__).parent)
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name, or a submodule, at first use (PEP 562)."""
    value: Any
    if name == "__version__":
        from importlib.metadata import version

        value = version("capsense")
    elif name in _HOME_OF:
        value = getattr(import_module(_HOME_OF[name]), name)
    elif name in _SUBMODULES:
        value = import_module(_SUBMODULES[name])
    else:
        raise AttributeError(f"module 'capsense' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
