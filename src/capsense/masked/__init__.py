"""The scheme of Schöffmann et al. 2022: masked tetrahedra, solved in full at every step."""

from capsense.masked.mesh_sensor import MeshSensor
