"""Physical constants (CODATA 2018)."""

import math

EPS0 = 8.8541878128e-12
"""Vacuum permittivity [F/m]."""
UNIT = 4 * math.pi * EPS0
"""Capacitance of a ball of one metre [F], the unit that kernels count in."""
LARGEST_TIE = 1e-3
"""Capacitances to ground beyond this [F] are slips of the pen."""
