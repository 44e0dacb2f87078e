"""Charge on the surfaces of bodies: panels of a rigid shape, and what they need of it once."""
