"""The field of a design in its empty surroundings: panels, boundary elements, Green's function."""
