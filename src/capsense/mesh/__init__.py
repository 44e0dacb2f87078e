"""Tetrahedral meshes: the {P, E, T} data, lattices, the Gmsh mesher, import and export.

Gmsh and meshio are imported where they are used.
"""

from capsense.mesh.gmsh_mesher import mesh_design
from capsense.mesh.io import load_mesh, save_mesh
from capsense.mesh.tetmesh import MeshQuality, TetMesh, kuhn_tets
