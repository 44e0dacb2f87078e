"""The options of all ``attach`` functions, and the rules by name that they stand for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from typing import Any, Literal, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number, as_whole, shorten, suggest
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.scene import Body, Material, Pose, Shape
from capsense.scene.materials import Grounding, checked_grounding, checked_material

Names = tuple[str, ...]
"""The names that one solid answers to, such as those of its geom and of its body."""
Shapes = Literal["collision", "visual", "both"]
"""Which shapes of a link are seen."""


@dataclass(frozen=True)
class Tie:
    """What ties solids to ground."""

    grounding: Grounding
    """``"grounded"``, ``"floating"`` or a capacitance [F]."""
    owner: str
    """The rule that says so."""

    def conductor(self, tree: int) -> str | None:
        """The conductor that a solid belongs to, as a body names it; None for one of its own.

        All solids of a rule that gives a capacitance are one conductor. Of a rule that lets them
        float, those are that hang together by joints.

        Args:
            tree: What hangs together by joints has the same number; -1 for what is fixed to the
                world.
        """
        if isinstance(self.grounding, float):
            return self.owner
        if self.grounding in ("grounded", "local") or tree < 0:
            return None
        return f"{self.owner}, tree {tree}"


def matches(pattern: str, names: Names) -> bool:
    """Whether a shell pattern (``*``, ``?``, ``[…]``; case matters) fits one of the names."""
    return any(fnmatchcase(name, pattern) for name in names)


class SeenOptions(TypedDict, total=False):
    """What a sensor sees, and what that is made of: keywords of every ``attach``.

    Patterns are shell patterns of names (``*``, ``?``, ``[…]``; case matters); which names an
    object answers to is said at the ``attach`` of each simulator. Where several patterns of one
    kind fit, the first decides.
    """

    materials: Mapping[str, Material | str] | None
    """Name pattern → material."""
    default_material: Material | str
    """The material where no pattern fits and the model itself does not say; steel by default."""
    default_grounding: Grounding
    """The grounding where no pattern fits and the model itself does not say: ``"grounded"``, which
    is the default, ``"floating"``, or a capacitance to ground [F]."""
    exclude: Sequence[str]
    """Name patterns of what the sensor does not see."""
    exclude_own: bool
    """Leave out the body that carries the sensor, which the design itself describes; True by
    default."""


class AttachOptions(SeenOptions, total=False):
    """Keywords of every ``attach`` that sees the shapes of a model themselves."""

    grounding: Mapping[str, Grounding] | None
    """Name pattern → grounding; a capacitance is that of all that the pattern fits together."""
    hull: Sequence[str]
    """Name patterns of meshes that are taken as their convex hulls."""
    shapes: Shapes
    """Which shapes of a link are seen: ``"collision"``, the default, those that collide, and those
    that are only drawn where none that collide stand in their place; ``"visual"``, the other way
    round; or ``"both"``, all of them."""


class ImageOptions(TypedDict, total=False):
    """Keywords of every ``attach`` that renders a depth image."""

    size: float | None
    """Width and height of the image [m]; by default the width of the design's domain."""
    resolution: int | None
    """Pixels along each side of the image, 64 by default."""
    back: str | float
    """Where what is seen ends: ``"fill"``, at the end of the domain, which is the default, or
    after an assumed thickness [m]; see :class:`~capsense.scene.depth.DepthFrame`."""


DEFAULTS: Mapping[str, object] = {
    "exclude_own": True, "back": "fill", "resolution": 64, "shapes": "collision",
    "contact_forces": True,
}  # fmt: skip
"""Options whose default is not None, empty or False."""


@dataclass(frozen=True)
class Rules:
    """The values of :class:`AttachOptions`, checked.

    Raises:
        ValueError: There is no such choice of shapes.
        SceneError: An unknown material or a wrong grounding.
    """

    materials: Mapping[str, Material | str] | None = None
    grounding: Mapping[str, Grounding] | None = None
    default_material: Material | str = "steel"
    default_grounding: Grounding = "grounded"
    exclude: Sequence[str] = ()
    exclude_own: bool = True
    hull: Sequence[str] = ()
    shapes: Shapes = "collision"

    def __post_init__(self) -> None:
        if self.shapes not in get_args(Shapes):
            known = ", ".join(f'"{each}"' for each in get_args(Shapes)[:-1])
            raise ValueError(f'shapes is {self.shapes!r}; choose {known} or "both"')
        put = object.__setattr__
        for key, checked in (("materials", checked_material), ("grounding", checked_grounding)):
            value = getattr(self, key) or {}
            if not isinstance(value, Mapping):
                raise SceneError(f"{key} is {value!r}; give a dict of name patterns")
            put(self, key, {pattern: checked(v) for pattern, v in value.items()})
        put(self, "default_material", checked_material(self.default_material))
        put(self, "default_grounding", checked_grounding(self.default_grounding))
        put(self, "exclude", _patterns("exclude", self.exclude))
        put(self, "hull", _patterns("hull", self.hull))

    def check(self, known: Sequence[Names]) -> None:
        """Refuse patterns that fit nothing, most likely typing errors.

        Args:
            known: The names of everything in the model.

        Raises:
            SceneError: Such a pattern; the message lists the names there are.
        """
        for what in ("materials", "grounding", "exclude", "hull"):
            for pattern in getattr(self, what):
                if not any(matches(pattern, names) for names in known):
                    every = dict.fromkeys(name for names in known for name in names)
                    raise SceneError(
                        f"{what}: nothing is named {pattern!r}; {suggest(pattern, every)}"
                    )

    def material_of(self, names: Names, own: Material | None = None) -> Material:
        """The material of something; ``own`` is what the model says of it."""
        for pattern, value in (self.materials or {}).items():
            if matches(pattern, names):
                return checked_material(value)
        return checked_material(self.default_material) if own is None else own

    def tie_of(self, names: Names, own: Tie | None = None) -> Tie:
        """What ties something to ground; ``own`` is what the model says of it."""
        for pattern, value in (self.grounding or {}).items():
            if matches(pattern, names):
                return Tie(value, f"pattern {pattern}")
        return Tie(self.default_grounding, "default") if own is None else own

    def body(self, shape: Shape, names: Names) -> Body:
        """A shape as a body at the origin, where the model says nothing of its own."""
        return Body(shape, Pose(), self.material_of(names), self.tie_of(names).grounding)

    def replaced(
        self, collides: NDArray[np.bool_], owner: NDArray[np.integer], boxes: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """The shapes that others of their link stand for, by :attr:`AttachOptions.shapes`.

        One is replaced if the middle of its box lies in the box around the link's shapes of the
        preferred kind. The world itself carries things that have nothing to do with each other:
        there it must lie in the box of one of them.

        Args:
            collides: Whether each collides, or is only drawn, shape (n,).
            owner: The link that carries it, negative for the world itself, shape (n,).
            boxes: Corners of a box around it in the link's frame [m], NaN for what has no end,
                shape (n, 2, 3).

        Returns:
            Shape (n,).
        """
        out = np.zeros(len(owner), dtype=bool)
        if self.shapes == "both":
            return out
        preferred = collides == (self.shapes == "collision")
        preferred &= ~np.isnan(boxes).any(axis=(1, 2))
        for link in np.unique(owner[preferred]).tolist():
            known = boxes[preferred & (owner == link)]
            if link >= 0:
                known = np.array([[known[:, 0].min(axis=0), known[:, 1].max(axis=0)]])
            others = np.flatnonzero((owner == link) & (collides != (self.shapes == "collision")))
            middle = boxes[others].mean(axis=1)[:, None]
            out[others] = (
                ((known[:, 0] <= middle) & (middle <= known[:, 1])).all(axis=2).any(axis=1)
            )
        return out

    def excludes(self, names: Names) -> bool:
        """Whether something of these names is left out."""
        return any(matches(p, names) for p in self.exclude)

    def takes_hull(self, names: Names) -> bool:
        """Whether a mesh of these names is taken as its convex hull."""
        return any(matches(p, names) for p in self.hull)


def check_perception(
    perception: object, options: Mapping[str, object], only: Mapping[str, Sequence[str]]
) -> None:
    """Refuse an unknown kind of perception, and options that belong to the other kind.

    Args:
        perception: What was asked for.
        options: The options that were given.
        only: Names of the options that only ``"geometry"`` has, or only ``"depth_camera"``.

    Raises:
        ValueError: There is no such kind of perception.
        SceneError: An option belongs to the other kind.
    """
    if perception not in ("geometry", "depth_camera"):
        raise ValueError(f'perception is {perception!r}; choose "geometry" or "depth_camera"')
    other = "geometry" if perception == "depth_camera" else "depth_camera"
    for name in only[other]:
        usual = DEFAULTS.get(name)
        if options.get(name, usual) not in (usual, None, (), [], {}):
            raise SceneError(
                f'{name} goes with perception="{other}"; leave it out of perception="{perception}"'
            )


@dataclass(frozen=True)
class Image:
    """The square depth image of a sensor, checked.

    Raises:
        SceneError: ``size`` is not a positive length, or ``resolution`` not a number of pixels
            from 4 to 2000.
    """

    size: float
    """Width and height [m]."""
    resolution: int = 64
    """Pixels along each side."""
    back: str | float = "fill"
    """Where what is seen ends, as of a depth frame."""

    def __post_init__(self) -> None:
        size, pixels = self.size, self.resolution
        if not 0 < as_number(size) < np.inf:
            raise SceneError(f"size is {size!r}; give the width of the image in metres")
        if not 4 <= (as_whole(pixels) or 0) <= 2000:
            raise SceneError(f"resolution is {pixels!r}; give a whole number from 4 to 2000")
        object.__setattr__(self, "size", float(size))
        object.__setattr__(self, "resolution", int(pixels))

    @classmethod
    def of(cls, options: Mapping[str, Any], design: Design) -> Image:
        """The image that ``ImageOptions`` ask for; without a size, as wide as the domain."""
        size, pixels = options.get("size"), options.get("resolution")
        return cls(
            float(max(design.domain.size[:2])) if size is None else size,
            64 if pixels is None else pixels, options.get("back", "fill"),
        )  # fmt: skip


def split_rules(options: Mapping[str, Any], known: type) -> tuple[Rules, dict[str, Any]]:
    """The rules among the keywords of an ``attach``, and the other keywords.

    Args:
        options: The keywords.
        known: The TypedDict of those that there are.

    Raises:
        TypeError: There is no such keyword.
        SceneError: An unknown material or a wrong grounding.
    """
    names = known.__annotations__
    for name in options:
        if name not in names:
            if name in ("preset", "method"):
                raise TypeError(
                    f"attach has no option {name!r}, which is the simulator's; give "
                    f"design=cs.Simulator(design, {name}=…)"
                )
            raise TypeError(
                f"attach has no option {shorten(name)}; {suggest(name, ['design', *names])}"
            )
    ruled = {f.name for f in fields(Rules)}
    rules = Rules(**{name: value for name, value in options.items() if name in ruled})
    return rules, {name: value for name, value in options.items() if name not in ruled}


def _patterns(what: str, patterns: object) -> tuple[str, ...]:
    if isinstance(patterns, str) or not isinstance(patterns, Iterable):
        raise SceneError(f"{what} is {patterns!r}; give a list of name patterns, like ['arm*']")
    out = tuple(patterns)
    for pattern in out:
        if not isinstance(pattern, str) or not pattern:
            raise SceneError(f"{what} holds {pattern!r}; give name patterns, like ['arm*']")
    return out


def read_grounding(text: str, where: str) -> Grounding:
    """A grounding written in a simulator's model: a word, or farads.

    Raises:
        SceneError: It is neither.
    """
    word = text.strip()
    try:
        value: object = float(word)
    except ValueError:
        value = word
    try:
        return checked_grounding(value)
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from None


def read_material(text: str, where: str) -> Material:
    """A material written in a simulator's model: its name.

    Raises:
        SceneError: There is no such material.
    """
    try:
        return checked_material(text.strip())
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from None
