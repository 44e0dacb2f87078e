"""Sensors in CoppeliaSim: ``cs.coppeliasim.attach(sim, "/Robot/link/pad")``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Unpack

from capsense.adapters.attached import Image, make_simulator
from capsense.adapters.coppeliasim_calls import Remote, translated
from capsense.adapters.coppeliasim_vision import (
    CoppeliaSensor,
    Paint,
    VisionSensor,
    carrier,
    find_vision_sensor,
    make_vision_sensor,
)
from capsense.adapters.rules import (
    DEFAULTS,
    ImageOptions,
    SeenOptions,
    as_material,
    split_rules,
)
from capsense.design.model import Design
from capsense.errors import AdapterError, MissingDependencyError, SceneError
from capsense.readout.readout import Readout
from capsense.scene import Pose
from capsense.simulator import Simulator, make_readout

__all__ = ["CoppeliaSensor", "attach", "connect", "running"]

_TRIES = 10
"""Steps after which a started simulation must be running."""


def connect(host: str = "localhost", port: int = 23000, timeout: float = 30.0) -> Any:
    """Connect to a running CoppeliaSim.

    Unlike with the client alone, which would wait for ever, every call fails where CoppeliaSim
    does not answer in time.

    Args:
        host: Where CoppeliaSim runs.
        port: Port of its ZeroMQ remote API server.
        timeout: How long a call may take [s], a simulation step included.

    Returns:
        CoppeliaSim's ``sim``.

    Raises:
        MissingDependencyError: The client is not installed.
        AdapterError: Nobody answers there, or in another version of the protocol.
    """
    try:
        import zmq
        from coppeliasim_zmqremoteapi_client import RemoteAPIClient
    except ImportError:
        raise MissingDependencyError(
            "CoppeliaSim's client is not installed; pip install 'capsense[coppelia]'"
        ) from None
    if not timeout > 0:
        raise AdapterError(f"timeout is {timeout!r}; give seconds above zero")
    client = RemoteAPIClient(host, port)
    client.socket.setsockopt(zmq.LINGER, 0)
    for way in (zmq.SNDTIMEO, zmq.RCVTIMEO):
        client.socket.setsockopt(way, round(1000 * timeout))
    try:
        return client.require("sim")
    except zmq.Again:
        raise AdapterError(
            f"nobody answers at {host}:{port} within {timeout:g} s; start CoppeliaSim with its "
            "ZMQ remote API server, or give its host and port"
        ) from None
    except Exception as error:  # the client raises nothing finer
        raise translated('client.require("sim")', error) from error


@contextmanager
def running(sim: Any) -> Iterator[Callable[[], float]]:
    """Run the simulation step by step: ``with running(sim) as step: step(); sensor.read()``.

    CoppeliaSim waits between steps. A simulation that is stopped is started, and stopped at the
    end; one that runs already goes on afterwards.

    Args:
        sim: What :func:`connect` or ``client.require("sim")`` returned.

    Yields:
        A function that makes one step and returns the simulation time [s].

    Raises:
        AdapterError: CoppeliaSim does not answer, does not start, or was stopped by someone
            else.
    """
    remote = Remote(sim)
    remote.call("setStepping", True)
    ours = remote.is_stopped()
    if ours:
        _start(remote)

    def step() -> float:
        remote.call("step")
        if remote.is_stopped():
            raise AdapterError("the simulation was stopped from elsewhere; run it again")
        return float(remote.call("getSimulationTime"))

    def leave() -> None:
        if ours:
            remote.call("stopSimulation")
        remote.call("setStepping", False)

    try:
        yield step
    except BaseException:
        with suppress(AdapterError):  # what went wrong first is what matters
            leave()
        raise
    leave()


def _start(remote: Remote) -> None:
    remote.call("startSimulation")
    for _ in range(_TRIES):
        if not remote.is_stopped():
            return
        remote.call("step")
    raise AdapterError("the simulation does not start; look for messages in CoppeliaSim")


class CoppeliaOptions(SeenOptions, ImageOptions, total=False):
    """Keywords of :func:`attach`."""


def attach(
    sim: Any,
    object: int | str,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    pose_in_object: Pose | None = None,
    readout: Readout | str | Path | None = None,
    **options: Unpack[CoppeliaOptions],
) -> CoppeliaSensor:
    """Attach a sensor to an object; call ``read()`` after every step.

    It sees the depth image of an orthographic vision sensor, and by the red channel what that is
    made of; see :func:`~capsense.scene.depth.decode_permittivity`.

    Where the object neither is a vision sensor nor carries one as its child, one is made, in the
    render mode "auxiliary channels", which knows no light, and what materials say is written into
    the auxiliary colours of all shapes in the scene. Name patterns are tried on a shape's name and
    on its path, such as ``/Person/arm``. Permittivities of dielectrics are rounded to whole
    numbers. Shapes added later want :meth:`CoppeliaSensor.refresh`.

    A vision sensor of the scene's own is taken as it is, and so is the red channel of its image;
    ``default_material`` is then that of everything seen, instead of what the red channel says.
    ``default_grounding`` is that of all conductors, which are one body.

    Args:
        sim: What :func:`connect` or ``client.require("sim")`` returned.
        object: The object that carries the sensor, by its path or handle.
        design: A design, a packaged name, a design file, or a ready simulator.
        pose_in_object: The sensor frame in the object's frame, by default that frame itself:
            origin at the centre of the electrode plane, z out of the sensor. A vision sensor of
            the scene's own is itself the sensor frame.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.attached.AttachedSensor.read`.
        options: What is seen and what it is made of: ``materials``, ``exclude`` and the others of
            :class:`~capsense.adapters.rules.SeenOptions`; ``size``, ``resolution`` and ``back`` of
            :class:`~capsense.adapters.rules.ImageOptions`.

    Raises:
        SceneError: There is no such object, a pattern fits nothing, its vision sensor is in
            perspective or of another resolution, or options do not go with that.
        AdapterError: CoppeliaSim does not answer, or is too old.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    if pose_in_object is not None and not isinstance(pose_in_object, Pose):
        raise SceneError(f"pose_in_object is {pose_in_object!r}; give a Pose(position, quaternion)")
    remote = Remote(sim)
    handle = remote.find(object)
    vision_sensor = find_vision_sensor(remote, handle)
    rules, other = split_rules(options, CoppeliaOptions)
    if vision_sensor is not None:
        _check_own(vision_sensor, {**options, "pose_in_object": pose_in_object})
    simulator = make_simulator(design)
    image = Image.of(other, simulator.design)
    chip = make_readout(readout, simulator)
    material = as_material(rules.default_material) if "default_material" in options else None
    paint = None
    if vision_sensor is None:  # all is checked: only now the scene is changed
        paint = Paint(remote, rules, carrier(remote, handle) if rules.exclude_own else None)
        far = float(simulator.design.domain.upper[2])
        vision_sensor = make_vision_sensor(
            remote, handle, pose_in_object or Pose(), image, far, paint.collection
        )
        material = None  # the colours say it
    sensor = CoppeliaSensor(
        remote, vision_sensor, simulator, rules.default_grounding, image.back, paint, material
    )
    sensor.use_readout(sensor.readout if readout is None else chip)
    return sensor


def _check_own(vision_sensor: VisionSensor, options: Mapping[str, Any]) -> None:
    """Refuse what does not go with a vision sensor of the scene's own."""
    for name in ("materials", "exclude", "pose_in_object", "size", "exclude_own"):
        usual = DEFAULTS.get(name)
        if options.get(name, usual) not in (usual, None, (), []):
            raise SceneError(
                f"{name} goes with a vision sensor that attach makes, but {vision_sensor.path!r} "
                "is there; leave one of them out"
            )
    (rows, columns), resolution = vision_sensor.resolution, options.get("resolution")
    if resolution is not None and (rows, columns) != (resolution, resolution):
        raise SceneError(
            f"vision sensor {vision_sensor.path!r} has {columns} x {rows} pixels, not "
            f"{resolution} x {resolution}; leave resolution out, or set it there"
        )
