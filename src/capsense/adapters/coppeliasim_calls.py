"""Calls to CoppeliaSim's ZeroMQ remote API; errors name the call that failed."""

from __future__ import annotations

from typing import Any

from capsense.adapters.attached import refuse_missing
from capsense.errors import AdapterError, SceneError

_FUNCTIONS = (
    "addItemToCollection", "createCollection", "createVisionSensor", "destroyCollection",
    "getObject", "getObjectAlias", "getObjectFloatParam", "getObjectInt32Param",
    "getObjectParent", "getObjectPose", "getObjectType", "getObjectsInTree",
    "getSimulationState", "getSimulationTime", "getVisionSensorDepth", "getVisionSensorImg",
    "handleVisionSensor", "isHandle", "removeObjects", "setObjectAlias", "setObjectInt32Param",
    "setObjectParent", "setObjectPose", "setShapeColor", "setStepping", "startSimulation",
    "step", "stopSimulation",
)  # fmt: skip
_CONSTANTS = (
    "colorcomponent_auxiliary", "handle_all", "handle_scene", "handle_single", "handle_world",
    "sceneobject_shape", "sceneobject_visionsensor", "simulation_stopped",
    "visionfloatparam_far_clipping", "visionfloatparam_near_clipping",
    "visionfloatparam_ortho_size", "visionintparam_entity_to_render",
    "visionintparam_perspective_operation",
    "visionintparam_render_mode", "visionintparam_resolution_x", "visionintparam_resolution_y",
)  # fmt: skip
OLDEST = "4.6"
"""The first CoppeliaSim that speaks the second version of the remote API's protocol."""
_FULL_PATH = 1
"""Option of ``sim.getObjectAlias``."""


class Remote:
    """CoppeliaSim's ``sim``, as far as a sensor needs it.

    Args:
        sim: What ``client.require("sim")`` returned.

    Raises:
        AdapterError: It lacks something that a sensor needs.
    """

    def __init__(self, sim: Any) -> None:
        missing = [n for n in (*_FUNCTIONS, *_CONSTANTS) if not hasattr(sim, n)]
        if "getObject" in missing or "getSimulationTime" in missing:
            raise AdapterError(
                f"sim is {sim!r}; give what capsense.coppeliasim.connect() or "
                'client.require("sim") returned'
            )
        if missing:
            raise AdapterError(
                f"this CoppeliaSim has no sim.{missing[0]}, which the sensor needs; it takes "
                f"CoppeliaSim {OLDEST} or later"
            )
        self.sim = sim

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of ``sim``.

        Raises:
            AdapterError: It does not answer, or refuses.
        """
        try:
            return getattr(self.sim, name)(*arguments)
        except Exception as error:  # the client raises nothing finer for what the server refuses
            raise translated(f"sim.{name}", error) from error

    def constant(self, name: str) -> int:
        """A number that ``sim`` knows by name."""
        return int(getattr(self.sim, name))

    def path(self, handle: int) -> str:
        """The path of an object in the scene, such as ``/Robot/link/pad``."""
        return str(self.call("getObjectAlias", handle, _FULL_PATH))

    def find(self, thing: object) -> int:
        """The handle of an object, from its path or the handle itself.

        Raises:
            SceneError: There is no such object.
        """
        if isinstance(thing, str):
            handle = self.call("getObject", thing, {"noError": True})
            if handle < 0:
                every = self.call("getObjectsInTree", self.constant("handle_scene"))
                raise refuse_missing("object", thing, [self.path(h) for h in every])
            return int(handle)
        if isinstance(thing, bool) or not isinstance(thing, int):
            raise SceneError(f"object is {thing!r}; give a path such as '/Robot/link/pad'")
        if not self.call("isHandle", thing):
            raise SceneError(f"there is no object of handle {thing}; give a path or a handle")
        return thing

    def is_stopped(self) -> bool:
        """Whether the simulation is stopped."""
        return bool(self.call("getSimulationState") == self.constant("simulation_stopped"))


def translated(what: str, error: Exception) -> AdapterError:
    """What the client raised at a call, as an error that names the mend."""
    import zmq

    if isinstance(error, zmq.Again):
        return AdapterError(
            f"CoppeliaSim did not answer {what} in time; is it still running? Connect again"
        )
    if isinstance(error, zmq.ZMQError):
        return AdapterError(
            f"the connection to CoppeliaSim is broken since a call failed ({what}: {error}); "
            "connect and attach again"
        )
    if isinstance(error, KeyError):  # the client misses the fields of its own protocol
        return AdapterError(
            f"CoppeliaSim answered {what} in another version of the remote API; it takes "
            f"CoppeliaSim {OLDEST} or later"
        )
    return AdapterError(f"{what}: {str(error).replace('_=NL=_', ' ').replace('_=TB=_', ' ')}")
