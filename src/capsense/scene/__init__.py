"""What stands in front of the sensor: materials, shapes, poses, bodies and scenes."""

from capsense.scene.body import Body
from capsense.scene.materials import MATERIALS, Material, material
from capsense.scene.mesh_shape import DistanceGrid, TriMesh
from capsense.scene.pose import Pose
from capsense.scene.scene import PackedScene, Scene
from capsense.scene.shape import Shape, ShapeKind
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere

__all__ = [
    "MATERIALS",
    "Body",
    "Box",
    "Capsule",
    "Cylinder",
    "DistanceGrid",
    "Ellipsoid",
    "Material",
    "PackedScene",
    "Pose",
    "Scene",
    "Shape",
    "ShapeKind",
    "Sphere",
    "TriMesh",
    "material",
]
