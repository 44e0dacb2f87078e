"""What holds for all parts of the public interface: one name, one default, one kind of error."""

from __future__ import annotations

import importlib
import inspect
import pydoc
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

import capsense as cs
from capsense import errors
from capsense.adapters import AttachedSensor
from capsense.adapters.skin import AttachedSkin
from capsense.readout.conversions import Held
from capsense.simulator import DEFAULT_DESIGN, DEFAULT_PRESET, PresetName
from capsense.solver.surface_solver import PRESETS

WITH_CHIPS = (cs.Simulator, cs.Skin, cs.Fleet, AttachedSensor, AttachedSkin)


def parameters(function: Callable[..., Any]) -> list[tuple[str, Any, Any, Any]]:
    """Names, kinds, defaults and types of what a function takes."""
    signature = inspect.signature(function)
    return [(p.name, p.kind, p.default, p.annotation) for p in signature.parameters.values()]


@pytest.mark.parametrize("name", ["use_readout", "reset"])
def test_readouts_are_set_and_reset_alike(name: str) -> None:
    """One signature, wherever sensors have chips; fleets have environments besides."""
    found = [getattr(kind, name) for kind in WITH_CHIPS if kind is not cs.Fleet]
    many = {p[0]: p[2] for p in parameters(getattr(cs.Fleet, name))}
    further = {"use_readout": "randomisation", "reset": "environments"}[name]
    assert many.pop(further) is None
    assert many == {p[0]: p[2] for p in parameters(found[0])}
    for function in found:
        assert parameters(function) == parameters(found[0]), function
        assert inspect.signature(function).return_annotation == "None"
    keywords = [
        (p[0], p[2]) for p in parameters(found[0]) if p[1] == inspect.Parameter.KEYWORD_ONLY
    ]
    assert keywords == [("start", None), ("seed", None)]


def defaults(name: str) -> dict[str, Any]:
    """Defaults of a parameter, of all public functions and classes that have it, by their names."""
    found = {}
    for public in cs.__all__:
        value = getattr(cs, public)
        some = {public: value}
        if inspect.ismodule(value):
            some = {f"{public}.{k}": getattr(value, k) for k in getattr(value, "__all__", ())}
            some |= {f"{public}.attach": value.attach} if hasattr(value, "attach") else {}
        for where, each in some.items():
            if callable(each) and not (
                inspect.isclass(each) and issubclass(each, dict | Exception)
            ):
                known = inspect.signature(each).parameters
                if name in known:
                    found[where] = known[name].default
    return found


def test_one_default_design() -> None:
    """Whatever attaches sensors takes the same design if it is given none, and so do simulators."""
    found = defaults("design")
    for adapter in ("mujoco", "pybullet", "assistive_gym", "coppeliasim"):
        assert found[f"{adapter}.attach"] == DEFAULT_DESIGN
    for adapter in ("mujoco", "pybullet"):
        assert found[f"{adapter}.attach_skin"] == DEFAULT_DESIGN
    assert set(found.values()) <= {DEFAULT_DESIGN, None, inspect.Parameter.empty}
    assert cs.Simulator().design.name == DEFAULT_DESIGN


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("mujoco_warp", "CapacitiveSensors"), ("newton", "SensorCapacitance"),
        ("genesis", "GenesisSensors"), ("mjlab", "CapacitanceCfg"),
    ],
)  # fmt: skip
def test_one_default_design_in_fleets(module: str, name: str) -> None:
    """So do the adapters whose simulators are installed."""
    try:
        adapter = importlib.import_module(f"capsense.adapters.{module}")
    except ImportError as error:
        pytest.skip(f"{error}")
    assert inspect.signature(getattr(adapter, name)).parameters["design"].default == DEFAULT_DESIGN


def test_one_default_preset() -> None:
    """Simulators and fleets resolve surfaces as finely, and so do all that take one."""
    found = defaults("preset")
    assert {"Simulator", "Fleet"} <= set(found)
    assert set(found.values()) == {DEFAULT_PRESET}


def test_presets_go_by_one_name() -> None:
    """``"learning"`` is taken for ``"fast"``, and does not come back."""
    assert tuple(PRESETS) == ("fast", "standard", "fine")
    assert set(get_args(PresetName)) == {*PRESETS, "learning"}
    ball = [cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.05)))]
    fast, same = (cs.Simulator("patch", preset=name) for name in ("fast", "learning"))
    assert fast.preset == same.preset == same.copy().preset == "fast"
    np.testing.assert_array_equal(same.step(cs.Scene(ball)).delta, fast.step(cs.Scene(ball)).delta)
    assert cs.Fleet("patch", ball, 1, preset="learning").finer == "standard"
    for make in (cs.Simulator, lambda name, preset: cs.Fleet(name, ball, 1, preset=preset)):
        for wrong in ("quick", None, 3):
            with pytest.raises(ValueError, match=r"one of 'fast', 'standard', 'fine'$"):
                make("patch", preset=wrong)


def test_errors_are_public() -> None:
    """All errors are, and are what Python has for the like."""
    known = {
        name: value
        for name, value in vars(errors).items()
        if inspect.isclass(value) and issubclass(value, errors.CapSenseError)
    }
    assert len(known) > 10
    for name, value in known.items():
        assert getattr(cs, name) is value
        assert value is cs.CapSenseError or issubclass(
            value, (ValueError, RuntimeError, ImportError)
        )


def test_wrong_arguments_are_what_python_has_for_them() -> None:
    """A wrong type is a TypeError, a wrong number or choice a ValueError, and no named error."""
    sim, ball = cs.Simulator("patch"), cs.Body(cs.Sphere(0.01))
    for call, kind in (
        (lambda: sim.step([ball]), TypeError),
        (lambda: sim.step_batch([[ball]]), TypeError),
        (lambda: sim.step_batch([], threads=0), ValueError),
        (lambda: cs.Skin(["patch"]), TypeError),
        (lambda: cs.Skin({"a": ("patch", cs.Pose())}, threads=0), ValueError),
        (lambda: cs.Fleet("patch", [ball], 0), ValueError),
        (lambda: cs.Simulator("patch", method="fem"), ValueError),
        (lambda: cs.plot(3), TypeError),
    ):  # fmt: skip
        with pytest.raises(kind) as caught:
            call()
        assert not isinstance(caught.value, cs.CapSenseError)


def test_readings_share_names() -> None:
    """What a fleet's reading has, a sensor's has too, of the same name and kind."""
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.05)))
    sim, fleet = cs.Simulator("dual_pad"), cs.Fleet("dual_pad", [ball], 2)
    sim.use_readout("fdc1004")
    fleet.use_readout("fdc1004")
    poses = np.array([[[0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0]]] * 2)
    for time in (0.0, 0.3):
        one = sim.step(cs.Scene([ball]), time=time, jacobian=True)
        many = fleet.step(poses, time=time, jacobian=True)
    names = [f.name for f in fields(many)]
    assert names.index("electrode_names") == 2
    for name in [*names, "self_capacitance", "mutual_capacitance"]:
        a, b = getattr(one, name), getattr(many, name)
        if name == "touch":
            assert [f.name for f in fields(a)] == [f.name for f in fields(b)]
        elif name in ("electrode_names", "conductance"):
            assert a == b, name
        elif name == "held":
            assert isinstance(a, Held)
            assert isinstance(b, Held)
            assert b.code.shape == (2, 1, *a.code.shape)
        elif name == "jacobian":
            np.testing.assert_allclose(b[1, 0], a, rtol=1e-3, atol=1e-5 * np.abs(a).max())
        else:
            assert np.shape(b) == (2, 1, *np.shape(a)), name
            np.testing.assert_allclose(b[1, 0], a, rtol=1e-3, atol=1e-20, err_msg=name)
    assert get_type_hints(type(one).held.fget, vars(importlib.import_module(
        "capsense.readout.conversions"
    )))["return"] == Held | None  # fmt: skip


def test_what_help_tells() -> None:
    """Names are listed before they are imported, and functions with what they take."""
    assert {"Simulator", "Fleet", "ReadoutError", "humans"} <= set(dir(cs))
    told = pydoc.render_doc(cs, renderer=pydoc.plaintext)
    for line in ("class Simulator(", "class Fleet(", "record(path", "show(sensor"):
        assert line in told, line
    assert "preset: 'PresetName' = 'standard'" in told
    program = "import capsense as cs; import pydoc; print('Simulator(' in pydoc.render_doc(cs))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "True"
