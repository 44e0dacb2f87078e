"""Sensors on the bodies of a MuJoCo model: ``cs.mujoco.attach(model, data, site="wrist_pad")``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import AttachedSensor, make_simulator, refuse_missing
from capsense.adapters.mujoco_model import ModelReader
from capsense.adapters.rules import Rules
from capsense.adapters.world import Frames, Solid
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, SceneError
from capsense.scene import Material
from capsense.scene.body import Grounding
from capsense.simulator import Simulator

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

__all__ = ["MujocoSensor", "attach"]

_SCALAR_LAST = [1, 2, 3, 0]


def attach(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    site: str,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    groups: Collection[int] | None = None,
) -> MujocoSensor:
    """Attach a sensor to a site of a model; call ``read()`` after every ``mj_step``.

    The site's frame is the sensor frame: origin at the centre of the electrode plane, z out of
    the sensor. Geoms become solids once, at this call; only their poses are taken at a reading.

    Patterns are shell patterns. They are tried on a geom's name (``geom3`` for the unnamed
    third, say), on its body's name, and on ``body/geom``. The model can say the same in its
    ``<custom>`` section: ``<text name="capsense.material:arm*" data="human"/>`` and
    ``<text name="capsense.grounding:arm*" data="100e-12"/>``. What is given here comes first,
    then the model's texts, then the defaults.

    Args:
        model: The model.
        data: Its state.
        site: Name of the site that carries the sensor.
        design: A design, a packaged name, a design file, or a ready simulator.
        materials: Name pattern → material; the first that fits decides.
        grounding: Name pattern → grounding; the first that fits decides.
        default_material: Material of everything else.
        default_grounding: Grounding of everything else.
        exclude: Name patterns of geoms that the sensor does not see.
        exclude_own: Leave out the geoms of the body that carries the site, which the design
            itself describes. The world's own geoms are never left out by this.
        hull: Name patterns of mesh geoms that are taken as their convex hulls.
        groups: See only geoms of these groups (MuJoCo's 0 to 5); default all.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        SceneError: There is no such site, a pattern fits nothing, a shape is not supported, or
            the data belong to another model.
        DesignError: The design is wrong.
    """
    _require()
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    _check_pair(model, data)
    return MujocoSensor(
        model, data, site, make_simulator(design), rules, exclude_own=exclude_own, groups=groups
    )


class MujocoSensor(AttachedSensor):
    """A sensor on a site of a MuJoCo model; made by :func:`attach`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        site: str,
        simulator: Simulator,
        rules: Rules,
        *,
        exclude_own: bool,
        groups: Collection[int] | None,
    ) -> None:
        import mujoco

        self.model = model
        """The model."""
        self.data = data
        """The state that readings are taken of."""
        self._rules = rules
        self._groups = None if groups is None else frozenset(int(g) for g in groups)
        self._site = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), site)
        if self._site < 0:
            raise refuse_missing("site", site, [model.site(i).name for i in range(model.nsite)])
        self._body = int(model.site_bodyid[self._site])
        self._own = self._body if exclude_own and self._body else None
        self._turn = np.empty(4)
        super().__init__(simulator)

    def _solids(self) -> list[Solid]:
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
        return solids

    def _frames(self) -> Frames:
        import mujoco

        data = self.data
        if not data.site_xmat[self._site].any():
            raise SceneError(
                "the data hold no poses yet; call mujoco.mj_forward(model, data) or mj_step first"
            )
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
