"""How the capacitance matrix changes with the poses of bodies."""
