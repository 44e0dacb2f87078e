"""People to be sensed: parametric arms and legs, and loaded body meshes.

- :mod:`~capsense.humans.limb`: how large people are; their arms and legs
- :mod:`~capsense.humans.chain`: chains of capsules with joints
- :mod:`~capsense.humans.formats`: these as MJCF and URDF; meshes of the SMPL family
"""

from capsense.humans.chain import Joint, LimbPart, Segment
from capsense.humans.formats import load_smplx
from capsense.humans.limb import Build, Limb, arm, leg

__all__ = ["Build", "Joint", "Limb", "LimbPart", "Segment", "arm", "leg", "load_smplx"]
