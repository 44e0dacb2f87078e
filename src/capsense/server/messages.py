"""Control messages of the protocol: JSON objects with a ``type``, checked as they are read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import numpy as np

from capsense import _validate
from capsense._validate import as_number
from capsense.errors import (
    CapSenseError,
    DesignError,
    MeshError,
    ProtocolError,
    ReadoutError,
    ScenarioError,
    SceneError,
    SolveError,
)
from capsense.humans import Build
from capsense.humans.limb import Side
from capsense.humans.tracking import CONVENTIONS, as_joints
from capsense.scenario import (
    MAX_FORCE,
    ScenarioTable,
    read_bodies,
    read_grounding,
    read_material,
    read_pose,
)
from capsense.scene import Body, DepthFrame, Material, Pose
from capsense.scene.camera import OrthographicCamera
from capsense.scene.materials import Grounding
from capsense.server.binary import HEADER, MAX_SENSOR, MAX_SEQUENCE, PROTOCOL, DepthMessage
from capsense.server.hands import HandOptions, HandsMessage, SeenHand

MAX_TEXT = 65536
"""Largest control message [bytes]."""
_DIGITS = 18
"""No integer has more; what is larger does not fit a float, or the machine."""
CODES = {
    "version": "the client speaks another version of the protocol; closes the connection",
    "token": "the token is missing or wrong; closes the connection",
    "timeout": "no hello in time; closes the connection",
    "full": "the server takes no more connections; closes the connection",
    "malformed": "a message is cut, padded, of an unknown kind, or a key or number in it is wrong",
    "limit": "an image, message or count is larger than the server allows",
    "sensor": "no sensor of that number is open, or one is already",
    "sequence": "a sequence number does not exceed the one before",
    "scene": "a depth frame, body, material or design is wrong",
    "watch": "this server does not let its clients watch sensors, or a client would both watch "
    "and have sensors",
    "readout": "the readout cannot go from the last time to this one",
    "solve": "the solver found no solution",
    "internal": "a fault of the server; its log says more",
}
"""Error codes."""
_CODE_OF: tuple[tuple[type[CapSenseError], str], ...] = (
    (ReadoutError, "readout"), (SolveError, "solve"), (SceneError, "scene"),
    (ScenarioError, "scene"), (MeshError, "scene"), (DesignError, "scene"),
)  # fmt: skip


class MessageTable(_validate.Table):
    """One object of a control message; whatever is wrong raises :class:`ProtocolError`."""

    error_type = ProtocolError


@dataclass(frozen=True)
class Hello:
    """The first message."""

    token: str
    client: str
    """What the client calls itself."""


@dataclass(frozen=True)
class Open:
    """A sensor is wanted."""

    sensor: int
    design: str
    """Empty for the server's first."""
    camera: OrthographicCamera
    material: Material | str
    """Of frames without permittivities."""
    grounding: Grounding
    back: Literal["fill"] | float
    touch: bool = False
    """Whether readings are to hold what is pressed onto a cover."""
    hands: HandOptions = field(default_factory=HandOptions)
    """Of hands that the client tracks."""
    table: Mapping[str, Any] = field(default_factory=dict, compare=False)
    """The message itself."""

    def seen(self, image: DepthMessage) -> DepthFrame:
        """What the sensor's camera saw."""
        eps_r = self.material if image.eps_r is None else image.eps_r
        return DepthFrame(image.depth, eps_r, self.camera, grounding=self.grounding, back=self.back)


@dataclass(frozen=True)
class Watch:
    """A sensor of another client is to be watched."""

    client: int | None
    """Number of the client; None for whichever sensor was opened last."""
    sensor: int


@dataclass(frozen=True)
class BodiesMessage:
    """A scene made of shapes."""

    sensor: int
    sequence: int
    time: float
    bodies: tuple[Body, ...]
    tables: tuple[Mapping[str, Any], ...]
    """What the client said of them; they may have moved since."""


@dataclass(frozen=True)
class PosesMessage:
    """Bodies of the last scene have moved."""

    sensor: int
    sequence: int
    time: float
    poses: Mapping[str, Pose]
    forces: Mapping[str, float | None] = field(default_factory=dict)
    """Normal forces that press bodies onto a cover [N]; None for none. Others keep theirs."""


def parse(text: str) -> MessageTable:
    """The object in a control message.

    Raises:
        ProtocolError: It is too long, no JSON object, or has no ``type``.
    """
    if len(text) > MAX_TEXT:
        raise ProtocolError(
            f"a control message has {len(text)} characters; up to {MAX_TEXT} are taken", "limit"
        )
    try:
        data = json.loads(text, parse_constant=_refuse_constant, parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"a control message is not JSON: {str(error)[:80]}") from None
    if not isinstance(data, dict):
        raise ProtocolError('a control message must be a JSON object, like {"type": "hello"}')
    kind = MessageTable(data, "message", "control message").string("type")
    return MessageTable(data, "message", _validate.shorten(kind))


def _integer(digits: str) -> int:
    if len(digits) > _DIGITS:
        raise ValueError(f"an integer has more than {_DIGITS} digits")
    return int(digits)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")


def read_hello(table: MessageTable) -> Hello:
    """Read the first message.

    Raises:
        ProtocolError: It is no ``hello``, of another version, or a key is wrong.
    """
    if table.data["type"] != "hello":
        raise table.error('comes before {"type": "hello"}; say hello first')
    table.only(("type", "protocol", "token", "client"))
    version = table.integer("protocol", 0, 2**31 - 1)
    if version != PROTOCOL:
        raise ProtocolError(
            f"the client speaks version {version} of the protocol; this server speaks {PROTOCOL}",
            "version",
        )
    return Hello(table.text("token"), table.text("client")[:80])


def read_open(table: MessageTable) -> Open:
    """Read an ``open``.

    Raises:
        ProtocolError: A key, type or number is wrong.
        CapSenseError: A camera, material or grounding is wrong.
    """
    table.only(
        ("type", "sensor", "design", "camera", "material", "grounding", "back", "touch", "hands")
    )
    options = ScenarioTable(table.data, "message", "open")
    back: Literal["fill"] | float = "fill"
    if table.data.get("back", "fill") != "fill":
        back = table.length("back")
    camera = _read_camera(MessageTable(table.data.get("camera", {}), "message", "camera"))
    return Open(
        _sensor(table), table.text("design"), camera, read_material(options, "steel"),
        read_grounding(options), back, table.boolean("touch", False),
        _read_hand_options(MessageTable(table.data.get("hands", {}), "message", "hands")),
        table.data,
    )  # fmt: skip


def _read_hand_options(table: MessageTable) -> HandOptions:
    table.only(("build", "filter"))
    build = MessageTable(table.data.get("build", {}), "message", "hands: build")
    build.only(("sex", "stature", "percentile", "girth"))
    filters = MessageTable(table.data.get("filter", {}), "message", "hands: filter")
    gaps = ("hold", "fade", "retreat", "min_confidence")
    filters.only((*_SMOOTH, *gaps))
    options = HandOptions(
        Build(**build.data),
        {k: filters.number(k, 0.0, 1e6) for k in _SMOOTH if k in filters},
        {k: filters.data[k] for k in gaps if k in filters},
    )
    options.make_filter()  # so that what is wrong is refused now
    return options


_SMOOTH = ("min_cutoff", "beta", "derivative_cutoff")
"""What may be said of the smoothing of hands."""


def read_watch(table: MessageTable) -> Watch:
    """Read a ``watch``.

    Raises:
        ProtocolError: A key, type or number is wrong.
    """
    table.only(("type", "client", "sensor"))
    if "client" not in table:
        table.only(("type",))
        return Watch(None, 0)
    return Watch(table.integer("client", 0, MAX_SEQUENCE), _sensor(table))


def _read_camera(table: MessageTable) -> OrthographicCamera:
    table.only(("width", "height", "near", "far", "rows", "columns", "pose"))
    pose = Pose()
    if "pose" in table:
        pose = read_pose(ScenarioTable(table.data["pose"], "message", "camera: pose"))
    return OrthographicCamera(
        table.length("width", 0.5), table.length("height", 0.5), pose,
        table.length("near", 0.0, zero=True), table.length("far", 0.5),
        cast("Literal['+y', '-y']", table.choice("rows", ("+y", "-y"), "+y")),
        cast("Literal['+x', '-x']", table.choice("columns", ("+x", "-x"), "+x")),
    )  # fmt: skip


def read_scene(table: MessageTable, max_bodies: int) -> BodiesMessage:
    """Read a ``scene``: bodies as in a scenario file, at rest and without files.

    Raises:
        ProtocolError: A key, type or number is wrong, or there are too many bodies.
        ScenarioError: A body is wrong.
    """
    table.only(("type", "sensor", "sequence", "time", "body"))
    raw = table.tables("body")
    if len(raw) > max_bodies:
        raise ProtocolError(
            f"the scene has {len(raw)} bodies; this server takes {max_bodies}", "limit"
        )
    for body in raw:
        if isinstance(body, Mapping) and (body.get("shape") == "mesh" or "trajectory" in body):
            raise table.error("meshes and trajectories are not taken here; send depth frames, or "
                              "a new pose for every step")  # fmt: skip
    bodies = read_bodies(ScenarioTable({"body": raw}, "message", "scene"), Path())
    return BodiesMessage(*_address(table), tuple(b.body for b in bodies), tuple(raw))


def read_poses(table: MessageTable, max_bodies: int) -> PosesMessage:
    """Read a ``poses``.

    Raises:
        ProtocolError: A key, type or number is wrong, or there are too many bodies.
        ScenarioError: A pose is wrong.
    """
    table.only(("type", "sensor", "sequence", "time", "poses", "forces"))
    raw = MessageTable(
        table.raw("poses", '{"name": {"position": [x, y, z]}}'), "message", "poses"
    ).data
    if len(raw) > max_bodies:
        raise ProtocolError(f"{len(raw)} poses; this server takes {max_bodies}", "limit")
    poses = {
        name: read_pose(ScenarioTable(pose, "message", f"pose of {name!r}"))
        for name, pose in raw.items()
    }
    given = MessageTable(table.data.get("forces", {}), "message", "forces")
    if len(given.data) > max_bodies:
        raise ProtocolError(f"{len(given.data)} forces; this server takes {max_bodies}", "limit")
    forces = {
        name: None if value is None else given.number(name, 0.0, MAX_FORCE, unit="N")
        for name, value in given.data.items()
    }
    return PosesMessage(*_address(table), poses, forces)


def read_hands(table: MessageTable) -> HandsMessage:
    """Read a ``hands``.

    Raises:
        ProtocolError: A key, type or number is wrong, or a side is there twice.
        SceneError: Joints are of another number than their convention has.
    """
    table.only(("type", "sensor", "sequence", "time", "hands"))
    table.raw("time", "seconds")
    table.raw("hands", '[{"side": "right", "joints": [[x, y, z], …]}]')
    raw = table.tables("hands")
    if len(raw) > len(_SIDES):
        raise ProtocolError(f"{len(raw)} hands; there are two sides", "limit")
    hands = [_read_hand(MessageTable(hand, "message", "hands")) for hand in raw]
    if len({hand.side for hand in hands}) < len(hands):
        raise table.error(f"two {hands[0].side} hands; one must be the other")
    return HandsMessage(*_address(table), tuple(hands))


_SIDES = ("left", "right")


def _read_hand(table: MessageTable) -> SeenHand:
    table.only(("side", "convention", "tip", "joints", "radii", "wrist", "confidence"))
    side = cast("Side", table.choice("side", _SIDES))
    name = table.choice("convention", tuple(CONVENTIONS), "openxr")
    count = CONVENTIONS[name].count
    tip: Any = table.choice("tip", ("skin", "inside")) if "tip" in table else None
    joints = table.data.get("joints")
    radii = table.data.get("radii")
    if radii is not None:
        if not isinstance(radii, list) or len(radii) != count:
            raise table.error(f"radii must be {count} numbers or null, those of {name}")
        radii = np.array([math.nan if r is None else as_number(r) for r in radii])
    return SeenHand(
        side, name, tip,
        None if joints is None else as_joints(joints, count, f"joints ({name})"), radii,
        table.coordinates("wrist", (3,)) if "wrist" in table else None,
        table.number("confidence", 0.0, 1.0, 1.0),
    )  # fmt: skip


def read_sensor(table: MessageTable) -> int:
    """Read a ``reset`` or ``close``: nothing but the sensor's number.

    Raises:
        ProtocolError: A key, type or number is wrong.
    """
    table.only(("type", "sensor"))
    return _sensor(table)


def _address(table: MessageTable) -> tuple[int, int, float]:
    """Sensor, sequence number and time [s] of a scene."""
    sequence = table.integer("sequence", 0, MAX_SEQUENCE)
    return _sensor(table), sequence, table.number("time", -1e300, 1e300, 0.0, unit="s")


def _sensor(table: MessageTable) -> int:
    return table.integer("sensor", 0, MAX_SENSOR)


def address_of(message: str | bytes) -> dict[str, int]:
    """Sensor and sequence number of a message, as far as they can be told, for an error."""
    if isinstance(message, bytes):
        if len(message) < HEADER.size:
            return {}
        fields = HEADER.unpack_from(message)
        return {"sensor": fields[4], "sequence": fields[8]}
    try:
        data = parse(message).data
    except ProtocolError:
        return {}
    keys = ("sensor", "sequence")
    return {k: data[k] for k in keys if type(data.get(k)) is int}


def code_of(error: CapSenseError) -> str:
    """The code of an error."""
    if isinstance(error, ProtocolError):
        return error.code
    return next((code for kind, code in _CODE_OF if isinstance(error, kind)), "internal")


def error_message(code: str, text: str, **address: int) -> dict[str, Any]:
    """The control message of an error."""
    return {"type": "error", "code": code, "message": text[:500], **address}
