"""What stands in front of the sensor: materials, shapes, poses, bodies and scenes."""

from capsense.scene.camera import OrthographicCamera, PerspectiveCamera
from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity, point_surface
from capsense.scene.layers import Layers, Raster, render_depth
from capsense.scene.materials import MATERIALS, Material, material
from capsense.scene.mesh_shape import DeformableSurface, RestSurface, SurfaceMesh, TriMesh
from capsense.scene.pose import Pose
from capsense.scene.scene import Body, PackedScene, Scene
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, ShapeKind, Sphere
