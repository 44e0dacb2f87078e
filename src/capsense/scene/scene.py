"""Scenes: the bodies around a sensor at one instant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.errors import SceneError
from capsense.scene.body import Body
from capsense.scene.shape import Shape

Array = NDArray[np.float64]


_SHOWN = 8
"""Bodies that are listed when a scene is printed."""


@dataclass(frozen=True, eq=False)
class PackedScene:
    """The geometry of a scene as flat arrays, in the order of its bodies."""

    kinds: NDArray[np.int64]
    """:class:`~capsense.scene.shape.ShapeKind` of every body, shape (n,)."""
    params: Array
    """Sizes [m], see :class:`~capsense.scene.shape.ShapeKind`, shape (n, 3)."""
    rotation: Array
    """Rotation matrices, body's frame to sensor frame, shape (n, 3, 3)."""
    position: Array
    """Origins of the bodies' frames [m] in the sensor frame, shape (n, 3)."""
    bounds: Array
    """Lower and upper corners of the bounding boxes [m] in the sensor frame, shape (n, 2, 3)."""
    shapes: tuple[Shape, ...]
    """The shapes themselves."""

    def __len__(self) -> int:
        return len(self.shapes)


@dataclass(frozen=True, init=False, eq=False)
class Scene:
    """An immutable, ordered collection of bodies.

    Args:
        bodies: The bodies, any iterable.

    Raises:
        SceneError: Something is not a :class:`Body`, or two bodies share a name.
    """

    bodies: tuple[Body, ...]

    def __init__(self, bodies: Iterable[Body] = ()) -> None:
        if isinstance(bodies, Body):
            raise SceneError("Scene takes a list of bodies; write Scene([body])")
        try:
            items = tuple(bodies)
        except TypeError:
            raise SceneError(f"Scene takes a list of bodies, not {bodies!r}") from None
        names: set[str] = set()
        for i, body in enumerate(items):
            if not isinstance(body, Body):
                mend = f"; write Body({body!r}, ...)" if isinstance(body, Shape) else ""
                raise SceneError(f"bodies[{i}] is {body!r}, not a Body{mend}")
            if body.name is not None:
                if body.name in names:
                    raise SceneError(f"two bodies are named {body.name!r}; names must differ")
                names.add(body.name)
        self.__dict__["bodies"] = items

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{b.name or 'unnamed'} ({type(b.shape).__name__})" for b in self.bodies[:_SHOWN]
        )
        more = f" and {len(self) - _SHOWN} more" if len(self) > _SHOWN else ""
        return f"<Scene of {len(self)}: {shown or 'nothing'}{more}>"

    def __iter__(self) -> Iterator[Body]:
        return iter(self.bodies)

    def __len__(self) -> int:
        return len(self.bodies)

    def __getitem__(self, key: int | str) -> Body:
        """Return a body by its index or its name.

        Raises:
            KeyError: No body of that name.
            IndexError: No body at that index.
        """
        if isinstance(key, str):
            for body in self.bodies:
                if body.name == key:
                    return body
            known = ", ".join(repr(b.name) for b in self.bodies if b.name is not None)
            raise KeyError(f"no body named {key!r}; named bodies: {known or 'none'}")
        return self.bodies[key]

    def pack(self) -> PackedScene:
        """Lay the geometry out as flat arrays for the solver's kernels."""
        from capsense.scene.place_kernels import place_bodies

        n = len(self.bodies)
        shapes = tuple([b.shape for b in self.bodies])
        table = np.array(
            [(b.shape.kind, *b.shape.packed, *b.pose.quaternion, *b.pose.position)
             for b in self.bodies]
        ).reshape(n, 14)  # fmt: skip
        rotation = np.empty((n, 3, 3))
        bounds = np.empty((n, 2, 3))
        place_bodies(table, rotation, bounds)
        kinds = table[:, 0].astype(np.int64)
        return PackedScene(kinds, table[:, 1:4], rotation, table[:, 11:], bounds, shapes)
