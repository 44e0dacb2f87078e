"""Sensors on the bodies of a MuJoCo model: ``cs.mujoco.attach(model, data, site="wrist_pad")``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import GeometrySensor, check_world, make_simulator
from capsense.adapters.mujoco_depth import MujocoDepthSensor, check_stepped, find_camera, find_site
from capsense.adapters.mujoco_model import ModelReader
from capsense.adapters.rules import Rules
from capsense.adapters.world import Frames, World
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, SceneError
from capsense.readout.read_out import ReadOut
from capsense.scene import Material
from capsense.scene.body import Grounding, checked_grounding
from capsense.simulator import Simulator

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

__all__ = ["MujocoDepthSensor", "MujocoSensor", "attach"]

_SCALAR_LAST = [1, 2, 3, 0]


def attach(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    site: str,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    world: Literal["geometry", "depth"] = "geometry",
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
    readout: ReadOut | str | None = None,
) -> MujocoSensor | MujocoDepthSensor:
    """Attach a sensor to a site of a model; call ``read()`` after every ``mj_step``.

    The site's frame is the sensor frame: origin at the centre of the electrode plane, z out of
    the sensor. With ``world="geometry"`` geoms become solids once, at this call, and only their
    poses and the vertices of flexes are taken at a reading.

    Patterns are shell patterns. They are tried on a geom's name (``geom3`` for the unnamed
    third, say), on its body's name, and on ``body/geom``; on a flex's name. The model can say the
    same in its ``<custom>`` section: ``<text name="capsense.material:arm*" data="human"/>`` and
    ``<text name="capsense.grounding:arm*" data="100e-12"/>``. What is given here comes first,
    then the model's texts, then the defaults. A capacitance to ground is that of all geoms that
    its pattern fits, together.

    With ``world="depth"`` the sensor sees the image of an orthographic camera that a rangefinder
    reads, which needs no OpenGL::

        <camera name="eye" projection="orthographic" resolution="64 64" fovy="0.5"/>
        <rangefinder camera="eye" data="depth"/>

    The camera should sit on the body of the site and look along the site's z: its frame is the
    site's, turned half round about x. It does not see the geoms of that body. Its rays tell no
    materials: everything is of the default ones.

    Args:
        model: The model.
        data: Its state.
        site: Name of the site that carries the sensor.
        design: A design, a packaged name, a design file, or a ready simulator.
        world: ``"geometry"``, the shapes themselves, or ``"depth"``, the image of a camera.
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
        readout: A chip, or its name, whose counts readings are to hold; see
            :meth:`~capsense.adapters.attached.AttachedSensor.read`.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        SceneError: There is no such site or camera, a pattern fits nothing, a shape is not
            supported, the camera is not orthographic or nothing reads it, the data belong to
            another model, or an option belongs to the other kind of world.
        DesignError: The design is wrong.
        ReadOutError: There is no such chip.
    """
    _require()
    _check_pair(model, data)
    only_geometry = {
        "materials": materials, "grounding": grounding, "exclude": exclude, "hull": hull,
        "groups": groups, "exclude_own=False": not exclude_own,
    }  # fmt: skip
    check_world(world, only_geometry, {"camera": camera, "back": back != "fill"})
    number = find_site(model, site)
    if world == "depth":
        eye = find_camera(model, site if camera is None else camera)
        sensor: MujocoSensor | MujocoDepthSensor = MujocoDepthSensor(
            model, data, number, eye, make_simulator(design), default_material,
            checked_grounding(default_grounding), back,
        )  # fmt: skip
        sensor.use_readout(readout)
        return sensor
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    sensor = MujocoSensor(
        model, data, number, make_simulator(design), rules, exclude_own=exclude_own, groups=groups
    )
    sensor.use_readout(readout)
    return sensor


class MujocoSensor(GeometrySensor):
    """A sensor on a site of a MuJoCo model; made by :func:`attach`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        site: int,
        simulator: Simulator,
        rules: Rules,
        *,
        exclude_own: bool,
        groups: Collection[int] | None,
    ) -> None:
        self.model = model
        """The model."""
        self.data = data
        """The state that readings are taken of."""
        self._rules = rules
        self._groups = None if groups is None else frozenset(int(g) for g in groups)
        self._site = site
        self._body = int(model.site_bodyid[self._site])
        self._own = self._body if exclude_own and self._body else None
        self._turn = np.empty(4)
        super().__init__(simulator)

    def _time(self) -> float:
        return float(self.data.time)

    def _world(self) -> World:
        reader = ModelReader(self.model, self._rules)
        solids = []
        for geom in range(self.model.ngeom):
            if self._groups is not None and int(self.model.geom_group[geom]) not in self._groups:
                continue
            if int(self.model.geom_bodyid[geom]) == self._own:
                continue
            solid = reader.solid(geom)
            if solid is not None:
                solids.append(solid)
        soft = [reader.soft_solid(flex, self.data) for flex in range(self.model.nflex)]
        return World(solids, self.simulator.design.domain, [s for s in soft if s is not None])

    def _frames(self) -> Frames:
        import mujoco

        data = self.data
        check_stepped(data, self._site)
        mujoco.mju_mulQuat(self._turn, data.xquat[self._body], self.model.site_quat[self._site])
        return Frames(
            data.xpos, data.xquat[:, _SCALAR_LAST], data.site_xpos[self._site],
            self._turn[_SCALAR_LAST],
        )  # fmt: skip


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
