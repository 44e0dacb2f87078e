"""People to be sensed: parametric people, hands, arms and legs, and loaded body meshes.

- :mod:`~capsense.humans.build`: how large people are
- :mod:`~capsense.humans.limb`: arms, legs and hands
- :mod:`~capsense.humans.fingers`: bones and joints of the hand
- :mod:`~capsense.humans.people`: whole people, their postures
- :mod:`~capsense.humans.ground`: their capacitance to ground
- :mod:`~capsense.humans.chain`: trees of capsules with joints
- :mod:`~capsense.humans.tracking`: joints of hands as trackers report them, filtered
- :mod:`~capsense.humans.tracked_hand`: a hand that follows them
- :mod:`~capsense.humans.hand_recording`: files of them
- :mod:`~capsense.humans.formats`: these as MJCF and URDF; meshes of the SMPL family
- :mod:`~capsense.humans.rigged`: meshes that follow bones, posed at every step
"""

from capsense.humans.build import Build
from capsense.humans.chain import Joint, LimbPart, Segment
from capsense.humans.formats import load_smplx
from capsense.humans.ground import capacitance_to_ground
from capsense.humans.hand_recording import HandRecording
from capsense.humans.limb import Limb, arm, hand, leg
from capsense.humans.people import ON_BACK, POSTURES, person
from capsense.humans.rigged import RiggedMesh, load_gltf, smplx_surface
from capsense.humans.tracked_hand import TrackedHand
from capsense.humans.tracking import HandFilter, HandSample, OneEuroFilter

__all__ = [
    "ON_BACK",
    "POSTURES",
    "Build",
    "HandFilter",
    "HandRecording",
    "HandSample",
    "Joint",
    "Limb",
    "LimbPart",
    "OneEuroFilter",
    "RiggedMesh",
    "Segment",
    "TrackedHand",
    "arm",
    "capacitance_to_ground",
    "hand",
    "leg",
    "load_gltf",
    "load_smplx",
    "person",
    "smplx_surface",
]
