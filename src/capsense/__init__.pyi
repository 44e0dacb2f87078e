"""The public names, and where they are from; see ``docs/conventions.md``."""

from capsense import humans, skin
from capsense.adapters import AttachedSensor, assistive_gym, coppeliasim, mujoco, pybullet
from capsense.design import available_designs, load_design
from capsense.design.model import Design
from capsense.errors import (
    AdapterError,
    BatchError,
    CapSenseError,
    DesignError,
    ExperimentalWarning,
    FieldError,
    LayoutError,
    MeshError,
    MissingDependencyError,
    PartialError,
    ProtocolError,
    ReadoutError,
    RecordingError,
    ScenarioError,
    SceneError,
    ServerError,
    SkinError,
    SolveError,
)
from capsense.fleet import Fleet, FleetReading
from capsense.layout import load_layout
from capsense.layout.board import BoardLayout
from capsense.plotting import plot
from capsense.reading import Reading, StepStats
from capsense.readout import Readout
from capsense.readout.calibration import calibrate
from capsense.readout.config import load_readout
from capsense.readout.conversions import Counts
from capsense.readout.presets import available_chips
from capsense.recording.reader import open_recording, replay
from capsense.recording.recorder import Recorder, record
from capsense.scenario import Scenario, load_scenario
from capsense.scene.camera import OrthographicCamera, PerspectiveCamera
from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity
from capsense.scene.layers import Layers, render_depth
from capsense.scene.materials import MATERIALS, Material
from capsense.scene.mesh_shape import TriMesh, point_surface
from capsense.scene.pose import Pose
from capsense.scene.scene import Body, DeformableSurface, Scene
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
from capsense.server.client import Client
from capsense.simulator import Simulator
from capsense.skin import Skin
from capsense.viewer import show

__version__: str

__all__ = [
    "MATERIALS", "AdapterError", "AttachedSensor", "BatchError", "BoardLayout", "Body", "Box",
    "CapSenseError",
    "Capsule", "Client", "Counts", "Cylinder", "DeformableSurface", "DepthFrame", "Design",
    "DesignError", "Ellipsoid", "ExperimentalWarning", "FieldError", "Fleet", "FleetReading",
    "Layers", "LayoutError", "Material", "MeshError", "MissingDependencyError",
    "OrthographicCamera", "PartialError", "PerspectiveCamera", "Pose", "ProtocolError", "Reading",
    "Readout", "ReadoutError", "Recorder", "RecordingError", "Scenario", "ScenarioError", "Scene",
    "SceneError", "ServerError", "Simulator", "Skin", "SkinError", "SolveError", "Sphere",
    "StepStats", "TriMesh", "__version__", "assistive_gym", "available_chips", "available_designs",
    "calibrate", "coppeliasim", "decode_permittivity", "encode_permittivity", "humans",
    "load_design", "load_layout", "load_readout", "load_scenario", "mujoco", "open_recording",
    "plot", "point_surface", "pybullet", "record", "render_depth", "replay", "show",
    "skin",
]  # fmt: skip
