"""Bodies as panels: shapes, meshes, mutual potentials of panels, distances to surfaces."""
