"""Sensors on the bodies of a MuJoCo model: ``cs.mujoco.attach(model, data, site="wrist_pad")``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import GeometrySensor, check_perception, make_simulator
from capsense.adapters.mujoco_depth import MujocoDepthSensor, check_stepped, find_camera, find_site
from capsense.adapters.mujoco_model import ModelSource
from capsense.adapters.mujoco_spec import add_sensor
from capsense.adapters.rules import Rules
from capsense.adapters.skin import AttachedSkin, simulators_of
from capsense.adapters.world import Frames
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, SceneError
from capsense.readout.readout import Readout
from capsense.scene import Material
from capsense.scene.scene import Grounding, checked_grounding
from capsense.simulator import Simulator
from capsense.skin import AnyDesign

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

__all__ = [
    "AttachedSkin", "MujocoDepthSensor", "MujocoSensor", "add_sensor", "attach", "attach_skin",
]  # fmt: skip

_SCALAR_LAST = [1, 2, 3, 0]


def attach(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    site: str,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    perception: Literal["geometry", "depth_camera"] = "geometry",
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    groups: Collection[int] | None = None,
    camera: str | None = None,
    back: str | float = "fill",
    readout: Readout | str | Path | None = None,
) -> MujocoSensor | MujocoDepthSensor:
    """Attach a sensor to a site of a model; call ``read()`` after every ``mj_step``.

    The site's frame is the sensor frame: origin at the centre of the electrode plane, z out of
    the sensor. With ``perception="geometry"`` geoms become solids once, at this call, and only
    their poses and the vertices of flexes are taken at a reading.

    Patterns are shell patterns. They are tried on a geom's name (``geom3`` for the unnamed
    third, say), on its body's name, and on ``body/geom``; on a flex's name. The model can say the
    same in its ``<custom>`` section: ``<text name="capsense.material:arm*" data="human"/>`` and
    ``<text name="capsense.grounding:arm*" data="100e-12"/>``. What is given here comes first,
    then the model's texts, then the defaults. A capacitance to ground is that of all geoms that
    its pattern fits, together.

    With ``perception="depth_camera"`` the sensor sees the image of an orthographic camera that a
    rangefinder reads, which needs no OpenGL::

        <camera name="pad" projection="orthographic" resolution="64 64" fovy="0.5"/>
        <rangefinder camera="pad" data="depth"/>

    The camera should sit on the body of the site and look along the site's z: its frame is the
    site's, turned half round about x. It does not see the geoms of that body. Its rays tell no
    materials: everything is of the default ones.

    Args:
        model: The model.
        data: Its state.
        site: Name of the site that carries the sensor.
        design: A design, a packaged name, a design file, or a ready simulator.
        perception: ``"geometry"``, the shapes themselves, or ``"depth_camera"``, the image of a
            camera.
        materials: Name pattern → material; the first that fits decides. Geometry only.
        grounding: Name pattern → grounding; the first that fits decides. Geometry only.
        default_material: Material of everything else.
        default_grounding: Grounding of everything else.
        exclude: Name patterns of geoms that the sensor does not see. Geometry only.
        exclude_own: Leave out the geoms of the body that carries the site, which the design
            itself describes. The world's own geoms are never left out by this. Geometry only.
        hull: Name patterns of mesh geoms that are taken as their convex hulls. Geometry only.
        groups: See only geoms of these groups (MuJoCo's 0 to 5); default all. Geometry only.
        camera: Name of the camera; by default that of the site. Depth only.
        back: Where what the camera sees ends: ``"fill"``, at the end of the domain, or after an
            assumed thickness [m]; see :class:`~capsense.scene.depth.DepthFrame`. Depth only.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.attached.AttachedSensor.read`.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        SceneError: There is no such site or camera, a pattern fits nothing, a shape is not
            supported, the camera is not orthographic or nothing reads it, the data belong to
            another model, or an option belongs to the other kind of perception.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    _require()
    _check_pair(model, data)
    only_geometry = {
        "materials": materials, "grounding": grounding, "exclude": exclude, "hull": hull,
        "groups": groups, "exclude_own=False": not exclude_own,
    }  # fmt: skip
    check_perception(perception, only_geometry, {"camera": camera, "back": back != "fill"})
    number = find_site(model, site)
    if perception == "depth_camera":
        depth_camera = find_camera(model, site if camera is None else camera)
        sensor: MujocoSensor | MujocoDepthSensor = MujocoDepthSensor(
            model, data, number, depth_camera, make_simulator(design), default_material,
            checked_grounding(default_grounding), back,
        )  # fmt: skip
        sensor.use_readout(sensor.readout if readout is None else readout)
        sensor.warn()
        return sensor
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    source = ModelSource(model, data, rules, groups)
    sensor = MujocoSensor(source, number, make_simulator(design), exclude_own=exclude_own)
    sensor.use_readout(sensor.readout if readout is None else readout)
    sensor.warn()
    return sensor


def attach_skin(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    sites: Sequence[str],
    design: AnyDesign | Mapping[str, AnyDesign] = "arm_segment",
    *,
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    groups: Collection[int] | None = None,
    readout: str | Path | None = None,
    threads: int | None = None,
) -> AttachedSkin:
    """Attach a sensor to each of several sites; one ``read()`` reads them all, in parallel.

    The model is taken over once for all of them, and sensors of one design share its field. Each
    sees the geometry from its own frame, without the geoms of its own body.

    Args:
        model: The model.
        data: Its state.
        sites: Names of the sites, which are also those of the readings.
        design: What :func:`attach` takes, for all sites, or site → design. A simulator that is
            given for several sites stands for its own design.
        materials: As for :func:`attach`, like all that follow up to ``groups``.
        grounding: Name pattern → grounding.
        default_material: Material of everything else.
        default_grounding: Grounding of everything else.
        exclude: Name patterns of geoms that no sensor sees.
        exclude_own: Leave out the geoms of the body that carries a sensor, for that sensor.
        hull: Name patterns of mesh geoms that are taken as their convex hulls.
        groups: See only geoms of these groups; default all.
        readout: Name of the chip behind every sensor, or the path of a readout file.
        threads: How many threads read; by default as many as the process may use processors.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        SceneError: There is no such site, a pattern fits nothing, a shape is not supported, or
            the data belong to another model.
        DesignError: A design is wrong.
        ReadoutError: There is no such chip.
    """
    _require()
    _check_pair(model, data)
    if isinstance(sites, str):
        raise SceneError(f"sites is {sites!r}; give a list of names, like [{sites!r}]")
    numbers = {site: find_site(model, site) for site in sites}
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    source = ModelSource(model, data, rules, groups)
    simulators = simulators_of(sites, design)
    sensors = {
        site: MujocoSensor(source, number, simulators[site], exclude_own=exclude_own)
        for site, number in numbers.items()
    }
    skin = AttachedSkin(sensors, readout, threads)
    skin.warn()
    return skin


class MujocoSensor(GeometrySensor):
    """A sensor on a site of a MuJoCo model; made by :func:`attach`."""

    source: ModelSource

    def __init__(
        self, source: ModelSource, site: int, simulator: Simulator, *, exclude_own: bool
    ) -> None:
        self.model = source.model
        """The model."""
        self.data = source.data
        """The state that readings are taken of."""
        self._site = site
        self._body = int(self.model.site_bodyid[site])
        self._exclude_own = exclude_own
        self._turn = np.empty(4)
        super().__init__(simulator, source)

    def _time(self) -> float:
        return float(self.data.time)

    def _own_frame(self) -> int | None:
        return self._body if self._exclude_own and self._body else None

    def _frames(self, position: Array, quaternion: Array) -> Frames:
        import mujoco

        data = self.data
        check_stepped(data, self._site)
        mujoco.mju_mulQuat(self._turn, data.xquat[self._body], self.model.site_quat[self._site])
        return Frames(position, quaternion, data.site_xpos[self._site], self._turn[_SCALAR_LAST])


def _require() -> None:
    try:
        import mujoco  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "MuJoCo is not installed; pip install 'capsense[mujoco]'"
        ) from None


def _check_pair(model: Any, data: Any) -> None:
    import mujoco

    if not isinstance(model, mujoco.MjModel):
        raise SceneError(f"model is a {type(model).__name__}; give a mujoco.MjModel")
    if not isinstance(data, mujoco.MjData):
        raise SceneError(f"data is a {type(data).__name__}; give a mujoco.MjData")
    if (len(data.xpos), len(data.site_xpos)) != (model.nbody, model.nsite):
        raise SceneError(
            f"the data belong to another model ({len(data.xpos)} bodies, not {model.nbody}); "
            "make them with mujoco.MjData(model)"
        )
