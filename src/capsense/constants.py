"""Physical constants (CODATA 2018) and fixed conventions of the package."""

EPS0 = 8.8541878128e-12
"""Vacuum permittivity [F/m]."""

MM = 1e-3
"""One millimetre [m]."""
