"""The options that all ``attach`` functions share."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import capsense as cs
from capsense.adapters.rules import AttachOptions, Image, Rules


def test_the_rules_are_the_options() -> None:
    """Every keyword is a rule, and every rule a keyword."""
    assert {f.name for f in fields(Rules)} == set(AttachOptions.__annotations__)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("mujoco", {"material": {}}, "no option 'material'; did you mean 'materials'"),
        ("mujoco", {"preset": "fine"}, r"no option 'preset'.*give design=cs.Simulator\(design, pr"),
        ("mujoco", {"desing": "patch"}, "no option 'desing'; did you mean 'design'"),
        ("mujoco", {"shape": "visual"}, "no option 'shape'; did you mean 'shapes'"),
        ("pybullet", {"groups": [1]}, "no option 'groups'.*resolution"),
    ],
)
def test_unknown_options_are_named(
    name: str, options: dict[str, Any], message: str, tiny_simulator: cs.Simulator
) -> None:
    """With the nearest one, and all of them."""
    simulator = pytest.importorskip(name)
    world: Any = (0, 0)
    if name == "mujoco":
        model = simulator.MjModel.from_xml_string(
            '<mujoco><worldbody><site name="pad"/></worldbody></mujoco>'
        )
        world = (model, simulator.MjData(model), "pad")
    with pytest.raises(TypeError, match=message):
        getattr(cs, name).attach(*world, design=tiny_simulator, **options)


def test_an_image_of_numpy_numbers() -> None:
    """They are numbers as any, and words are none."""
    image = Image(np.float32(0.5), np.int64(32))  # type: ignore[arg-type]
    assert image == Image(0.5, 32)
    assert (type(image.size), type(image.resolution)) == (float, int)
    for wrong in ("0.5", True, math.nan, math.inf, 0.0):
        with pytest.raises(cs.SceneError, match="give the width of the image in metres"):
            Image(wrong)  # type: ignore[arg-type]
    for wrong in (64.0, True, 3, 2001):
        with pytest.raises(cs.SceneError, match="give a whole number from 4 to 2000"):
            Image(0.5, wrong)  # type: ignore[arg-type]
