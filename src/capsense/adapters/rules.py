"""What the things of a simulator are made of, and what ties them to ground: rules by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.scene import Material, material
from capsense.scene.scene import Grounding, checked_grounding

Names = tuple[str, ...]
"""The names that one solid answers to, such as those of its geom and of its body."""


@dataclass(frozen=True)
class Tie:
    """What ties solids to ground."""

    grounding: Grounding
    """``"grounded"``, ``"floating"`` or a capacitance [F]."""
    owner: str
    """The rule that says so. All solids of one rule share a capacitance: they are one body."""


def matches(pattern: str, names: Names) -> bool:
    """Whether a shell pattern (``*``, ``?``, ``[…]``; case matters) fits one of the names."""
    return any(fnmatchcase(name, pattern) for name in names)


@dataclass(frozen=True)
class Rules:
    """What a sensor sees of a model, and what that is made of, by name patterns.

    Where several patterns of one kind fit, the first decides.

    Raises:
        SceneError: An unknown material or a wrong grounding.
    """

    materials: Mapping[str, Material | str] = field(default_factory=dict)
    """Name pattern → material."""
    grounding: Mapping[str, Grounding] = field(default_factory=dict)
    """Name pattern → grounding; a capacitance is that of all it fits together."""
    default_material: Material | str = "steel"
    """The material where neither a pattern fits nor the model itself says."""
    default_grounding: Grounding = "grounded"
    """The grounding where neither a pattern fits nor the model itself says."""
    exclude: Sequence[str] = ()
    """Name patterns of what is left out."""
    hull: Sequence[str] = ()
    """Name patterns of the meshes that are taken as their convex hulls."""

    def __post_init__(self) -> None:
        for what in ("materials", "grounding"):
            value = getattr(self, what)
            if not isinstance(value, Mapping):
                raise SceneError(f"{what} is {value!r}; give a dict of name patterns")
        put = object.__setattr__
        put(self, "materials", {k: as_material(v) for k, v in self.materials.items()})
        put(self, "grounding", {k: checked_grounding(v) for k, v in self.grounding.items()})
        put(self, "default_material", as_material(self.default_material))
        put(self, "default_grounding", checked_grounding(self.default_grounding))
        put(self, "exclude", _patterns("exclude", self.exclude))
        put(self, "hull", _patterns("hull", self.hull))

    def check(self, known: Sequence[Names]) -> None:
        """Refuse patterns that fit nothing, which are slips of the pen.

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
        for pattern, value in self.materials.items():
            if matches(pattern, names):
                return as_material(value)
        return as_material(self.default_material) if own is None else own

    def tie_of(self, names: Names, own: Tie | None = None) -> Tie:
        """What ties something to ground; ``own`` is what the model says of it."""
        for pattern, value in self.grounding.items():
            if matches(pattern, names):
                return Tie(value, f"pattern {pattern}")
        return Tie(self.default_grounding, "default") if own is None else own

    def excludes(self, names: Names) -> bool:
        """Whether something of these names is left out."""
        return any(matches(p, names) for p in self.exclude)

    def takes_hull(self, names: Names) -> bool:
        """Whether a mesh of these names is taken as its convex hull."""
        return any(matches(p, names) for p in self.hull)


def _patterns(what: str, patterns: object) -> tuple[str, ...]:
    if isinstance(patterns, str) or not isinstance(patterns, Iterable):
        raise SceneError(f"{what} is {patterns!r}; give a list of name patterns, like ['arm*']")
    out = tuple(patterns)
    for pattern in out:
        if not isinstance(pattern, str) or not pattern:
            raise SceneError(f"{what} holds {pattern!r}; give name patterns, like ['arm*']")
    return out


def as_material(value: Material | str) -> Material:
    """A material, from itself or its name.

    Raises:
        SceneError: No such material.
    """
    return value if isinstance(value, Material) else material(value)


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
        return material(text.strip())
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from None
