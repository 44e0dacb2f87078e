"""The scheme of Schöffmann et al. 2022: masked tetrahedra, solved in full at every step."""

from capsense.masked.mesh_sensor import MeshSensor, mesh_sensor
from capsense.masked.planes import FREE, WALL, hold_nodes, lattice_sensor, plan_axes
from capsense.masked.scenes import MaskedScenes

__all__ = [
    "FREE",
    "WALL",
    "MaskedScenes",
    "MeshSensor",
    "hold_nodes",
    "lattice_sensor",
    "mesh_sensor",
    "plan_axes",
]
