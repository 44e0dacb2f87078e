"""The options that all ``attach`` functions share."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest

import capsense as cs
from capsense.adapters.rules import AttachOptions, Rules


def test_the_rules_are_the_options() -> None:
    """Every keyword is a rule, and every rule a keyword."""
    assert {f.name for f in fields(Rules)} == set(AttachOptions.__annotations__)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("mujoco", {"material": {}}, "no option 'material'; did you mean 'materials'"),
        ("mujoco", {"preset": "fine"}, r"no option 'preset'.*give design=cs.Simulator\(design, pr"),
        ("mujoco", {"desing": "patch"}, "no option 'desing'; did you mean 'design'"),
        ("mujoco", {"shapes": "visual"}, "no option 'shapes'.*groups"),
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
