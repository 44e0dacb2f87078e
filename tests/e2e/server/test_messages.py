"""Control messages: what they mean, and that nothing malformed gets through."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import capsense as cs
from capsense.errors import CapSenseError, ProtocolError
from capsense.server import messages

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
READERS = {
    "hello": messages.read_hello,
    "open": messages.read_open,
    "scene": lambda table: messages.read_scene(table, 8),
    "poses": lambda table: messages.read_poses(table, 8),
    "reset": messages.read_sensor,
}

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)
KEYS = (
    "sensor", "sequence", "time", "protocol", "token", "camera", "material", "grounding", "back",
    "body", "poses", "design",
)  # fmt: skip


def read(kind: str, **content: Any) -> Any:
    """What a message of a kind is read as."""
    return READERS[kind](messages.parse(json.dumps({"type": kind, **content})))


@given(st.text(max_size=60) | json_values.map(json.dumps))
def test_any_text(text: str) -> None:
    """Text that is no message raises the one error, and no other."""
    try:
        table = messages.parse(text)
    except ProtocolError:
        return
    assert isinstance(table.data["type"], str)


@given(st.sampled_from(sorted(READERS)), st.dictionaries(st.sampled_from(KEYS), json_values))
def test_any_content(kind: str, content: dict[str, Any]) -> None:
    """Objects with any values are read, or raise an error that has a code."""
    code = "none"
    try:
        read(kind, **content)
    except CapSenseError as error:
        code = messages.code_of(error)
    assert code in {"none", "malformed", "version", "limit", "scene"}


def test_texts_that_break_parsers() -> None:
    """Deep nesting, huge numbers and constants that JSON lacks."""
    for text in (
        "[" * 60000, '{"type":' * 8000, '{"type": "a", "x": ' + "9" * 400 + "}", "\ud800",
        '{"type": "reset", "sensor": NaN}', '"hello"', "{}", '{"type": 3}',
    ):  # fmt: skip
        with pytest.raises(ProtocolError) as caught:
            messages.parse(text)
        assert caught.value.code == "malformed"
    with pytest.raises(ProtocolError, match="65537 characters") as caught:
        messages.parse(" " * 65537)
    assert caught.value.code == "limit"


def test_hello() -> None:
    """Version first, then everything else."""
    assert read("hello", protocol=1) == messages.Hello("", "")
    assert read("hello", protocol=1, token="secret", client="me").token == "secret"
    with pytest.raises(
        ProtocolError, match="version 2 of the protocol; this server speaks 1"
    ) as caught:
        read("hello", protocol=2)
    assert caught.value.code == "version"
    with pytest.raises(ProtocolError, match="say hello first"):
        messages.read_hello(messages.parse('{"type": "open"}'))


def test_open() -> None:
    """Defaults are those documented; every key arrives."""
    plain = read("open", sensor=3)
    assert plain == messages.Open(3, "", cs.OrthographicCamera(), "steel", "grounded", "fill")
    pose = {"position": [0.1, 0.2, 0.3], "quaternion": [0.0, 0.0, 1.0, 0.0]}
    camera = {"width": 0.2, "height": 0.3, "near": 0.01, "far": 0.4, "rows": "-y", "columns": "-x"}
    full = read(
        "open", sensor=0, design="patch", camera={**camera, "pose": pose},
        material={"eps_r": 3.0}, grounding=1e-10, back=0.02,
    )  # fmt: skip
    assert full.camera == cs.OrthographicCamera(
        pose=cs.Pose((0.1, 0.2, 0.3), (0, 0, 1, 0)), **camera
    )
    assert (full.design, full.material.eps_r, full.grounding, full.back) == (
        "patch",
        3,
        1e-10,
        0.02,
    )


@pytest.mark.parametrize(
    ("content", "code", "words"),
    [
        ({}, "malformed", "missing key 'sensor'"),
        ({"sensor": -1}, "malformed", "integer from 0"),
        ({"sensor": 1.0}, "malformed", "integer from 0"),
        ({"sensor": 0, "colour": 1}, "malformed", "unknown key 'colour'"),
        ({"sensor": 0, "camera": {"width": -1}}, "malformed", "positive"),
        ({"sensor": 0, "camera": {"near": 0.5, "far": 0.4}}, "scene", "must exceed near"),
        ({"sensor": 0, "camera": {"rows": "up"}}, "malformed", "rows = 'up'"),
        ({"sensor": 0, "back": "half"}, "malformed", "back"),
        ({"sensor": 0, "grounding": "no"}, "scene", "grounding"),
        ({"sensor": 0, "material": 3}, "scene", "material"),
    ],
)
def test_wrong_open(content: dict[str, Any], code: str, words: str) -> None:
    """What is wrong is named."""
    with pytest.raises(CapSenseError, match=re.escape(words)) as caught:
        read("open", **content)
    assert messages.code_of(caught.value) == code


def test_scene_and_poses() -> None:
    """Bodies as in a scenario file; poses by name."""
    ball = {"name": "ball", "shape": "sphere", "radius": 0.03, "material": "water",
            "grounding": "floating", "pose": {"position": [0, 0, 0.06]}}  # fmt: skip
    scene = read("scene", sensor=1, sequence=4, time=0.5, body=[ball])
    assert (scene.sensor, scene.sequence, scene.time) == (1, 4, 0.5)
    (body,) = scene.bodies
    assert (body.name, body.shape.radius, body.material.name) == ("ball", 0.03, "water")
    assert (body.grounding, body.pose) == ("floating", cs.Pose((0, 0, 0.06)))
    poses = read("poses", sensor=1, sequence=5, poses={"ball": {"position": [1, 2, 3]}})
    assert (poses.time, poses.poses) == (0.0, {"ball": cs.Pose((1, 2, 3))})
    for wrong, code in (
        ([{**ball, "trajectory": {}}], "malformed"), ([ball] * 9, "limit"), ([ball, ball], "scene"),
        ([{"name": "x", "shape": "mesh", "file": "/etc/passwd", "unit": "m"}], "malformed"),
        ([{**ball, "radius": -1}], "scene"), (["ball"], "scene"), ("ball", "malformed"),
    ):  # fmt: skip
        with pytest.raises(CapSenseError) as caught:
            read("scene", sensor=1, sequence=4, body=wrong)
        assert messages.code_of(caught.value) == code, wrong
        assert "passwd" not in str(caught.value)


def test_address_of_any_message() -> None:
    """An error names the sensor and frame where they can be told."""
    assert messages.address_of('{"type": "scene", "sensor": 2, "sequence": 7}') == {
        "sensor": 2, "sequence": 7,
    }  # fmt: skip
    for wrong in ('"2"', "true", "2.0", "null"):
        assert messages.address_of('{"type": "scene", "sensor": ' + wrong + "}") == {}
    for message in ("{", b"", b"CSNS"):
        assert messages.address_of(message) == {}


def test_the_page_lists_the_codes() -> None:
    """Codes and their meaning, as documented."""
    text = PAGE.partition("## Error codes\n")[2].partition("\n\nClose codes")[0]
    assert dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", text, flags=re.MULTILINE)) == messages.CODES
