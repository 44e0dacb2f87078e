"""Deformables: what bends is seen as it is at every reading."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs

SHEET = 0.06
"""Edge of the sheets [m]."""


def cloth_in_mujoco(simulator: cs.Simulator, gravity: str = "0 0 0", **options: Any) -> Any:
    """A square sheet 30 mm in front of a sensor that looks up."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="{gravity}"/><worldbody>'
        '<body name="link"><geom size=".01"/><site name="pad"/></body>'
        '<flexcomp name="cloth" type="grid" count="5 5 1" spacing=".015 .015 .015" pos="0 0 .03" '
        'radius=".001" dim="2" mass=".1"><edge equality="true"/></flexcomp>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    simulator.reset()
    return cs.mujoco.attach(model, data, "pad", simulator, **options)


@pytest.fixture
def soft_client() -> Iterator[int]:
    """A world of PyBullet that takes soft bodies."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    number = p.connect(p.DIRECT)
    p.resetSimulation(p.RESET_USE_DEFORMABLE_WORLD, physicsClientId=number)
    yield number
    p.disconnect(physicsClientId=number)


def write_obj(file: Path, vertices: Any, faces: Any) -> str:
    """A mesh file, with the material file that Bullet asks for."""
    lines = ["v " + " ".join(repr(float(x)) for x in v) for v in vertices]
    lines += ["f " + " ".join(str(int(i) + 1) for i in f) for f in faces]
    file.write_text("\n".join(lines) + "\n")
    return str(file)


def grid(n: int = 5, edge: float = SHEET) -> tuple[np.ndarray, np.ndarray]:
    """A square sheet in the plane z = 0."""
    axis = np.linspace(-edge / 2, edge / 2, n)
    x, y = np.meshgrid(axis, axis)
    index = np.arange(n * n).reshape(n, n)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def soft_in_pybullet(
    client: int,
    mesh: tuple[Any, Any],
    folder: Path,
    simulator: cs.Simulator,
    step: bool,
    **options: Any,
) -> Any:
    """A soft body 30 mm in front of a sensor that looks up."""
    import pybullet as p

    ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.01, physicsClientId=client)
    pad = p.createMultiBody(0, ball, physicsClientId=client)
    p.loadSoftBody(
        write_obj(folder / "soft.obj", *mesh), basePosition=(0, 0, 0.03), mass=0.1,
        useMassSpring=1, springElasticStiffness=40, useBendingSprings=1, collisionMargin=1e-4,
        physicsClientId=client,
    )  # fmt: skip
    if step:
        p.setTimeStep(1e-6, physicsClientId=client)
        p.stepSimulation(physicsClientId=client)
    simulator.reset()
    return cs.pybullet.attach(client, pad, design=simulator, **options)


def plain(simulator: cs.Simulator, shape: Any, **body: Any) -> cs.Reading:
    """The reading of one rigid body 30 mm in front of the sensor."""
    simulator.reset()
    out = simulator.step(cs.Scene([cs.Body(shape, cs.Pose((0, 0, 0.03)), **body)]))
    simulator.reset()
    return out


def test_a_flat_flex_reads_as_a_plate(tiny_simulator: cs.Simulator) -> None:
    """Differential: within 3 % of a thin box; its 32 triangles are the shape."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    sensor = cloth_in_mujoco(tiny_simulator, materials={"cloth": "steel"})
    (body,) = sensor.scene()
    assert len(body.shape.faces) == 32
    assert sensor.scene()[0].shape.faces is body.shape.faces
    box = plain(tiny_simulator, cs.Box((SHEET, SHEET, 0.0002)))
    assert np.diag(sensor.read().delta) == approx(np.diag(box.delta), rel=0.03, abs=0)


def test_a_falling_flex_is_followed(tiny_simulator: cs.Simulator) -> None:
    """It comes closer, and the sensor feels more and more."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    sensor = cloth_in_mujoco(tiny_simulator, gravity="0 0 -9.81")
    felt = []
    for _ in range(4):
        felt.append(sensor.read().delta[0, 0])
        mujoco.mj_step(sensor.model, sensor.data, 8)
    assert np.all(np.diff(felt) > 0)


def test_a_solid_flex_is_filled(tiny_simulator: cs.Simulator) -> None:
    """A flex of tetrahedra has an inside: volume and reading are those of the box that it is."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><geom size=".01"/><site name="pad"/></body>'
        '<flexcomp name="block" type="grid" count="4 4 3" spacing=".015 .015 .01" pos="0 0 .03" '
        'radius=".0001" dim="3" mass=".1"><edge equality="true"/></flexcomp></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    tiny_simulator.reset()
    sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator)
    shape = cs.Box((0.045, 0.045, 0.02))
    assert sensor.scene()[0].shape.volume == approx(shape.volume, rel=1e-6)
    found, box = sensor.read(), plain(tiny_simulator, shape)
    assert np.diag(found.delta) == approx(np.diag(box.delta), rel=0.03, abs=0)


def test_flexes_are_excluded_by_name(tiny_simulator: cs.Simulator) -> None:
    """Names are known to the patterns."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    assert len(cloth_in_mujoco(tiny_simulator, exclude=["clo*"]).scene()) == 0
    with pytest.raises(cs.SceneError, match="nothing is named 'cloht'; did you mean 'cloth'"):
        cloth_in_mujoco(tiny_simulator, materials={"cloht": "cotton"})


def cable_in_mujoco(simulator: cs.Simulator, elements: str) -> Any:
    """A flex of five points and some lines, 30 mm in front of a sensor."""
    import mujoco

    points = " ".join(f"{0.015 * k - 0.03} 0 .03" for k in range(5))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><geom size=".01"/><site name="pad"/></body>'
        f'<flexcomp name="cable" type="direct" dim="1" radius=".004" mass=".1" point="{points}" '
        f'element="{elements}"><edge equality="true"/></flexcomp></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    simulator.reset()
    return cs.mujoco.attach(model, data, "pad", simulator)


def test_a_straight_cable_reads_as_a_rod(tiny_simulator: cs.Simulator) -> None:
    """Differential: within 5 % of a cylinder of its radius; it follows its points."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    sensor = cable_in_mujoco(tiny_simulator, "0 1 1 2 2 3 3 4")
    (body,) = sensor.scene()
    assert body.shape.closed
    np.testing.assert_allclose(body.shape.volume, np.pi * 0.004**2 * 0.06, rtol=1e-3)
    tiny_simulator.reset()
    rod = cs.Body(cs.Cylinder(0.004, 0.06), cs.Pose.from_euler((0, 0, 0.03), (0, np.pi / 2, 0)))
    wanted = tiny_simulator.step(cs.Scene([rod])).delta
    found = sensor.read().delta
    np.testing.assert_allclose(np.diag(found), np.diag(wanted), rtol=0.05)
    sensor.data.qpos[2::3] -= 0.01
    import mujoco

    mujoco.mj_forward(sensor.model, sensor.data)
    assert sensor.read().delta[0, 0] > 1.1 * found[0, 0]


@pytest.mark.parametrize("elements", ["0 1 1 2 1 3 3 4", "0 1 2 3 3 4", "0 1 1 2 2 0 3 4"])
def test_lines_that_are_no_path_are_refused(tiny_simulator: cs.Simulator, elements: str) -> None:
    """Hostile: the error names the flex and the way out."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    with pytest.raises(cs.SceneError, match=r"'cable' is of lines that branch.*exclude="):
        cable_in_mujoco(tiny_simulator, elements)


def test_a_soft_sheet_reads_as_a_plate(
    soft_client: int, tmp_path: Path, tiny_simulator: cs.Simulator
) -> None:
    """Differential: within 3 % of a thin box."""
    sensor = soft_in_pybullet(soft_client, grid(), tmp_path, tiny_simulator, True)
    (body,) = sensor.scene()
    assert body.name.startswith("soft")
    assert not body.shape.closed
    box = plain(tiny_simulator, cs.Box((SHEET, SHEET, 0.0002)))
    assert np.diag(sensor.read().delta) == approx(np.diag(box.delta), rel=0.03, abs=0)


def test_a_closed_soft_body_is_filled(
    soft_client: int, tmp_path: Path, tiny_simulator: cs.Simulator
) -> None:
    """Differential: a soft box within 3 % of the rigid one."""
    shape = cs.Box((0.04, 0.04, 0.02))
    mesh = shape.to_trimesh()
    sensor = soft_in_pybullet(
        soft_client, (mesh.vertices, mesh.faces), tmp_path, tiny_simulator, True
    )
    assert sensor.scene()[0].shape.volume == approx(shape.volume, rel=0.05)
    found = np.diag(sensor.read().delta)
    assert found == approx(np.diag(plain(tiny_simulator, shape).delta), rel=0.03, abs=0)


def test_a_soft_body_must_have_been_stepped(
    soft_client: int, tmp_path: Path, tiny_simulator: cs.Simulator
) -> None:
    """Before the first step Bullet draws it in another place."""
    import pybullet as p

    sensor = soft_in_pybullet(soft_client, grid(), tmp_path, tiny_simulator, False)
    with pytest.raises(cs.SceneError, match=r"'soft.* has not been stepped yet; call stepSim"):
        sensor.read()
    p.setTimeStep(1e-6, physicsClientId=soft_client)
    p.stepSimulation(physicsClientId=soft_client)
    assert sensor.read().delta[0, 0] > 0
