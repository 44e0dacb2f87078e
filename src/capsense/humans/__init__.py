"""People to be sensed: parametric arms and legs, and loaded body meshes.

- :mod:`~capsense.humans.anthropometry`: how large people are
- :mod:`~capsense.humans.limb`: chains of capsules with joints, posed in a scene
- :mod:`~capsense.humans.formats`: the same as MJCF and URDF
- :mod:`~capsense.humans.formats`: meshes of the SMPL family, with the user's own model files
"""

from capsense.humans.anthropometry import Build
from capsense.humans.formats import load_smplx
from capsense.humans.limb import Joint, Limb, LimbPart, Segment, arm, leg

__all__ = ["Build", "Joint", "Limb", "LimbPart", "Segment", "arm", "leg", "load_smplx"]
