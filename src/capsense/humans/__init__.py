"""People to be sensed: parametric arms and legs, and loaded body meshes.

- :mod:`~capsense.humans.limb`: how large people are; their arms and legs
- :mod:`~capsense.humans.chain`: chains of capsules with joints
- :mod:`~capsense.humans.formats`: these as MJCF and URDF; meshes of the SMPL family
- :mod:`~capsense.humans.rigged`: meshes that follow bones, posed at every step
"""

from capsense.humans.chain import Joint, LimbPart, Segment
from capsense.humans.formats import load_smplx
from capsense.humans.limb import Build, Limb, arm, leg
from capsense.humans.rigged import RiggedMesh, load_gltf, smplx_surface

__all__ = [
    "Build", "Joint", "Limb", "LimbPart", "RiggedMesh", "Segment", "arm", "leg", "load_gltf",
    "load_smplx", "smplx_surface",
]  # fmt: skip
