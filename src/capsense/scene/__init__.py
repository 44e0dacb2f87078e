"""What stands in front of the sensor: materials, shapes, poses, bodies and scenes."""

from capsense.scene.body import Body
from capsense.scene.camera import OrthographicCamera
from capsense.scene.deformable import DeformableSurface
from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity
from capsense.scene.layers import LayerGrid, Layers
from capsense.scene.materials import MATERIALS, Material, material
from capsense.scene.mesh_shape import DistanceGrid, TriMesh
from capsense.scene.pose import Pose
from capsense.scene.raster import Raster, rasterise
from capsense.scene.scene import PackedScene, Scene
from capsense.scene.shape import Shape, ShapeKind
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere

__all__ = [
    "MATERIALS",
    "Body",
    "Box",
    "Capsule",
    "Cylinder",
    "DeformableSurface",
    "DepthFrame",
    "DistanceGrid",
    "Ellipsoid",
    "LayerGrid",
    "Layers",
    "Material",
    "OrthographicCamera",
    "PackedScene",
    "Pose",
    "Raster",
    "Scene",
    "Shape",
    "ShapeKind",
    "Sphere",
    "TriMesh",
    "decode_permittivity",
    "encode_permittivity",
    "material",
    "rasterise",
]
