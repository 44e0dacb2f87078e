"""What stands in front of the sensor: materials, shapes, poses, bodies and scenes."""

from capsense.scene.body import Body
from capsense.scene.camera import OrthographicCamera, PerspectiveCamera
from capsense.scene.deformable import DeformableSurface
from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity
from capsense.scene.layers import Layers
from capsense.scene.materials import MATERIALS, Material, material
from capsense.scene.mesh_shape import TriMesh
from capsense.scene.point_surface import point_surface
from capsense.scene.pose import Pose
from capsense.scene.raster import Raster, render_depth
from capsense.scene.scene import PackedScene, Scene
from capsense.scene.shape import Shape, ShapeKind
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
from capsense.scene.surface_mesh import RestSurface, SurfaceMesh

__all__ = [
    "MATERIALS",
    "Body",
    "Box",
    "Capsule",
    "Cylinder",
    "DeformableSurface",
    "DepthFrame",
    "Ellipsoid",
    "Layers",
    "Material",
    "OrthographicCamera",
    "PackedScene",
    "PerspectiveCamera",
    "Pose",
    "Raster",
    "RestSurface",
    "Scene",
    "Shape",
    "ShapeKind",
    "Sphere",
    "SurfaceMesh",
    "TriMesh",
    "decode_permittivity",
    "encode_permittivity",
    "material",
    "point_surface",
    "render_depth",
]
