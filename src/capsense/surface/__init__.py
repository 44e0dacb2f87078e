"""The surface core: charges on bodies against the Green's function of a design, step by step."""
