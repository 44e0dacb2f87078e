"""Patches of a skin on one link: where they are, and the design of each."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number
from capsense.design import parse_design
from capsense.design.model import Design
from capsense.errors import SceneError, listed
from capsense.field.boundary import Accuracy, build_cost, build_model
from capsense.field.cache import default_settings
from capsense.scene import Pose, Scene
from capsense.scene.contact import find_contacts, points_on

Array = NDArray[np.float64]

LARGE_DEVIATION = 5e-4
"""A design that leaves the surface of the link by more than this [m] brings a warning."""
BACKING = 0.10
"""The housing behind an electrode is longer than that by this [m]."""
FLATTEST = 0.15
"""Electrodes on larger radii [m] are flat."""
_RESOLUTION = 0.5
"""``[build] resolution`` of the designs of patches: against 1, readings change by up to 1 % from
3 mm on, and by up to 4 % at 1 mm (``benchmarks/skin_make.py --resolution``)."""
_SIGHT = 0.40
"""Side of the box in which a patch looks for bodies [m]."""
_READ = 5e-4
"""About how long a patch that sees something takes to read [s] (``examples/painted_skin.py``)."""


def checked_length(name: str, value: object) -> float:
    """A length from 10 µm to 1 m.

    Raises:
        SceneError: It is none.
    """
    number = as_number(value)
    if not 1e-5 <= number <= 1.0:
        raise SceneError(f"{name} is {value!r}; give a length in metres, such as 0.012")
    return number


@dataclass(frozen=True)
class Pad:
    """A disc electrode that is bent with the link.

    Raises:
        SceneError: A length is not from 10 µm to 1 m, or there is no such housing.
    """

    size: float = 0.012
    """Diameter [m]."""
    depth: float = 0.003
    """Distance of the electrode from the housing behind it [m]."""
    housing: Literal["shield", "ground"] = "shield"
    """Whether the link behind the electrode is driven as a shield or is ground."""

    def __post_init__(self) -> None:
        for name in ("size", "depth"):
            checked_length(name, getattr(self, name))
        if self.housing not in ("shield", "ground"):
            raise SceneError(f"housing is {self.housing!r}; give 'shield' or 'ground'")


@dataclass(frozen=True, eq=False, repr=False)
class SkinLayout(Mapping[str, tuple[Design, Pose]]):
    """Patches on a link: name → (design, pose in the frame of the link), as ``cs.Skin`` takes them.

    Printing a layout tells what it will cost. It cannot be changed.
    """

    patches: Mapping[str, tuple[Design, Pose]]
    """Design of each patch, and its pose in the frame of the link; z points out of the link."""
    deviation: Mapping[str, float] = field(default_factory=dict)
    """How far the design of a patch leaves the surface of the link [m], where that is known."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Patches and taxels that are not among ``patches``, and why."""

    def __getitem__(self, name: str) -> tuple[Design, Pose]:
        return self.patches[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.patches)

    def __len__(self) -> int:
        return len(self.patches)

    @property
    def designs(self) -> dict[str, Design]:
        """Design of each patch, as the adapters' ``attach_skin`` takes it."""
        return {name: design for name, (design, _) in self.patches.items()}

    def poses(self, link: Pose | None = None) -> dict[str, Pose]:
        """Pose of each patch in the world, as ``cs.Skin.step`` takes it.

        Args:
            link: Pose of the link in the world; by default the identity.
        """
        at = Pose() if link is None else link
        return {name: at @ pose for name, (_, pose) in self.patches.items()}

    def clear_of(self, neighbours: Scene) -> SkinLayout:
        """This layout without the patches of which an electrode lies inside other bodies.

        Args:
            neighbours: The bodies, in the frame of the link.

        Returns:
            The patches that are clear; ``left_out`` names the others and the bodies.

        Raises:
            SceneError: All patches lie inside bodies.
        """
        kept, out = {}, dict(self.left_out)
        points: dict[int, Array] = {}
        for name, (design, pose) in self.patches.items():
            if id(design) not in points:
                triangles = [e.surface.triangles for e in design.electrodes]
                points[id(design)] = points_on(np.concatenate(triangles))
            found = find_contacts(neighbours, {name: pose.apply(points[id(design)])})[0]
            if found.met:
                out[name] = f"inside {listed(found.bodies, 2)}"
            else:
                kept[name] = (design, pose)
        if not kept:
            raise SceneError(
                f"all {len(self)} patches lie inside other bodies, such as {next(iter(out))!r}, "
                f"{next(iter(out.values()))}; check the frame and the unit of the layout"
            )
        return replace(self, patches=kept, left_out=out)

    @cached_property
    def _build_seconds(self) -> float:
        """Estimated time of building the fields [s]; their panels are cut once for that."""
        designs = {id(d): d for d, _ in self.patches.values()}.values()
        scales = [Accuracy(default_settings(d).panel_scale) for d in designs]
        models = (build_model(d.in_units, a) for d, a in zip(designs, scales, strict=True))
        return sum(build_cost(model.panels.size)[0] for model in models)

    def __repr__(self) -> str:
        designs = {id(d): d for d, _ in self.patches.values()}
        electrodes = sum(len(d.electrodes) for d, _ in self.patches.values())
        lines = [
            f"{len(self)} patches, {electrodes} electrodes, {len(designs)} distinct designs",
            f"to build: about {self._build_seconds:.0f} s, or nothing where fields are cached",
            f"to read: at most about {1e3 * _READ * len(self):.0f} ms on one core, "
            "less where few patches see something",
        ]
        if self.deviation:
            worst = max(self.deviation, key=self.deviation.__getitem__)
            lines.append(
                f"off the surface: at most {1e3 * self.deviation[worst]:.2g} mm ({worst!r})"
            )
        if self.left_out:
            name, why = next(iter(self.left_out.items()))
            lines.append(f"left out: {len(self.left_out)}, such as {name!r}: {why}")
        return "\n".join(lines)

    def warn(self) -> SkinLayout:
        """Warn of designs that leave the surface too far; return the layout itself."""
        bad = [name for name, off in self.deviation.items() if off > LARGE_DEVIATION]
        if bad:
            worst = 1e3 * max(self.deviation.values())
            warnings.warn(
                f"{len(bad)} of {len(self)} patches leave the surface of the link by up to "
                f"{worst:.2g} mm ({listed(bad, 3)}), so near bodies are read roughly; use smaller "
                "patches, or leave strongly curved parts out with region",
                stacklevel=3,
            )
        return self


def pad_design(outline: Mapping[str, Any], size: float, radius: float, pad: Pad) -> Design:
    """One electrode on a link, as a film at a distance from the housing.

    The housing reaches 50 mm beyond the electrode: a sheet, or a cylinder where it is bent.

    Args:
        outline: Keys of the electrode's shape, as in a design file.
        size: Its largest extent [m].
        radius: Of the cylinder that it is bent onto [m], infinite where it is flat.
        pad: How far the housing is, and what it is.
    """
    breadth = size + BACKING
    side = max(_SIGHT, 2 * breadth)
    round_link = math.isfinite(radius)
    backplane = round((2 * radius if round_link else pad.depth) + 0.02, 6)
    conductor: dict[str, Any] = {"name": "housing", "role": pad.housing}
    if round_link:
        conductor |= {
            "shape": "cylinder", "radius": radius - pad.depth, "length": breadth,
            "center": [0.0, 0.0, -radius], "tilt": [90, 0, 0],
        }  # fmt: skip
    else:
        conductor |= {"shape": "rectangle", "size": [breadth, breadth], "z": -pad.depth}
    data: dict[str, Any] = {
        "name": f"pad on a radius of {1e3 * radius:g} mm" if round_link else "pad",
        "domain": {"size": [side, side, side + backplane], "backplane": backplane, "open": True},
        "electrode": [{"name": "E1", **outline}],
        "conductor": [conductor],
        "build": {"resolution": _RESOLUTION},
    }
    if round_link:
        data["bend"] = {"radius": radius}
    return parse_design(data, source="skin")
