"""What stands in front of the sensor: materials, shapes, poses, bodies and scenes."""

from capsense.scene.camera import OrthographicCamera, PerspectiveCamera
from capsense.scene.depth import DepthFrame, decode_permittivity, encode_permittivity
from capsense.scene.layers import Layers, Raster, render_depth
from capsense.scene.materials import MATERIALS, Material, Ties, material
from capsense.scene.mesh_shape import RestSurface, SurfaceMesh, TriMesh, point_surface
from capsense.scene.pose import Pose
from capsense.scene.scene import Body, DeformableSurface, PackedScene, Scene
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, ShapeKind, Sphere
