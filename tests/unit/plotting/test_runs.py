"""Pictures of readings and recordings: what they show, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import capsense as cs

HEIGHTS = np.linspace(0.15, 0.03, 5)


@pytest.fixture
def sim(simulators: Callable[..., cs.Simulator]) -> cs.Simulator:
    return simulators("six_patch")


@pytest.fixture
def scenes() -> list[cs.Scene]:
    """A ball that comes down, and a box that is there at the end only."""
    ball = [cs.Body(cs.Sphere(0.03), cs.Pose((0.02, 0, z)), "human", name="ball") for z in HEIGHTS]
    box = cs.Body(cs.Box((0.02, 0.02, 0.02)), cs.Pose((-0.05, 0.0, 0.05)), name="box")
    return [cs.Scene([b]) for b in ball[:-1]] + [cs.Scene([ball[-1], box])]


def lines_of(figure: object, title: str) -> dict[str, np.ndarray]:
    """Data of the lines of the axes above which a legend has a title, by label."""
    for axes in figure.axes:  # type: ignore[attr-defined]
        legend = axes.get_legend()
        if legend is not None and legend.get_title().get_text() == title:
            lines = [line for line in axes.get_lines() if not line.get_label().startswith("_")]
            return {line.get_label(): line.get_ydata() for line in lines}
    raise AssertionError(f"no axes named {title}")


def test_readings(sim: cs.Simulator, scenes: list[cs.Scene]) -> None:
    """Changes of self capacitances from the empty scene; the ball's way beside them."""
    readings = [sim.step(scene) for scene in scenes]
    figure = cs.plot(readings, sim, scenes=scenes, excitation="self")
    drawn = lines_of(figure, "self capacitance")
    assert list(drawn) == ["E6", "E5", "E4", "E3", "E2", "E1"]
    wanted = [r.self_capacitance[2] - sim.empty.self_capacitance[2] for r in readings]
    (axes,) = (a for a in figure.axes if a.get_ylabel() == "change from the empty scene [fF]")
    np.testing.assert_allclose(drawn["E3"], 1e15 * np.array(wanted), rtol=1e-9)
    assert axes.get_xlabel() == "number of the reading"
    timed = cs.plot(readings, sim, times=HEIGHTS, excitation="self")
    assert timed.axes[0].get_xlabel() == "time [s]"
    texts = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert texts.count("ball") == texts.count("box") == 2


def test_a_recording(sim: cs.Simulator, scenes: list[cs.Scene], tmp_path: Path) -> None:
    """It shows what its readings show."""
    pytest.importorskip("mcap", reason='needs pip install "capsense[record]"')
    with cs.record(tmp_path / "a.mcap", sim) as run:
        readings = [run.step(s, time=0.1 * k) for k, s in enumerate(scenes)]
    recorded = lines_of(cs.plot(cs.open_recording(tmp_path / "a.mcap")), "mutual capacitance")
    direct = lines_of(cs.plot(readings, sim), "mutual capacitance")
    assert recorded.keys() == direct.keys()
    for label, values in direct.items():
        np.testing.assert_array_equal(recorded[label], values)


def test_readings_of_a_sensor_on_a_robot(sim: cs.Simulator, scenes: list[cs.Scene]) -> None:
    """The sensor stands for its simulator."""

    class Ridden(cs.AttachedSensor):
        pose = cs.Pose()

        def scene(self) -> cs.Scene:
            return scenes[-1]

    sensor = Ridden(sim)
    readings = [sensor.read()]
    ridden = lines_of(cs.plot(readings, sensor), "mutual capacitance")
    np.testing.assert_equal(ridden, lines_of(cs.plot(readings, sim), "mutual capacitance"))


def test_a_design() -> None:
    assert cs.plot(cs.load_design("stripe")).axes[0].get_title(loc="left") == "stripe"


def test_refusals(sim: cs.Simulator, scenes: list[cs.Scene]) -> None:
    """Readings come with their simulator, and as many times and scenes."""
    readings = [sim.step(scene) for scene in scenes]
    with pytest.raises(ValueError, match="give plot"):
        cs.plot(readings)
    for wrong in (readings[0], "six_patch"):
        with pytest.raises(TypeError, match=f"not {type(wrong).__name__}; write plot"):
            cs.plot(wrong, sim)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="excitation is 'slf'; did you mean 'self'"):
        cs.plot(readings, sim, excitation="slf")
    with pytest.raises(ValueError, match="no reading"):
        cs.plot([], sim)
    with pytest.raises(ValueError, match=r"shape \(2,\); give as many"):
        cs.plot(readings, sim, times=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"shape \(5,\) and 4 scenes; give as many"):
        cs.plot(readings, sim, scenes=scenes[:-1])


def test_the_style_sheet_has_the_colours_of_all_pictures() -> None:
    """What pages draw with ``plt.style.use`` looks as what ``capsense run`` draws."""
    import matplotlib.style

    from capsense._style import COLOURS, FAINT, INK

    with matplotlib.style.context("capsense.plotting.capsense"):
        colours = [entry["color"] for entry in matplotlib.rcParams["axes.prop_cycle"]]
        assert [f"#{c.lstrip('#')}".upper() for c in colours] == [c.upper() for c in COLOURS]
        assert f"#{matplotlib.rcParams['axes.edgecolor'].lstrip('#')}" == FAINT
        assert f"#{matplotlib.rcParams['axes.labelcolor'].lstrip('#')}" == INK


@pytest.mark.parametrize(
    ("names", "written", "listed"),
    [
        (["a", "b", "c"], {"a", "b", "c"}, set()),
        (
            [f"finger {k}" for k in range(10)],
            {"1", "10"},
            {f"{k + 1}  finger {k}" for k in range(10)},
        ),
        ([f"arm/link{k}" for k in range(8)] + ["hand"], {"arm", "hand"}, set()),
        (["a/1", "a/2", "b", "c", "d/e"], {"1", "2", "3", "4"}, {"1  a", "2  b", "3  c", "4  d/e"}),
    ],
)
def test_names_of_bodies_do_not_cover_one_another(
    names: list[str], written: set[str], listed: set[str], sim: cs.Simulator
) -> None:
    """Bodies on one spot, seen along their row: a list tells the rest. Of many parts, one name."""
    row = [
        cs.Body(cs.Sphere(0.02), cs.Pose((0.05 * k - 0.2, 0.0, 0.06)), "steel", name=name)
        for k, name in enumerate(names)
    ]
    moved = [cs.Scene([b.moved(cs.Pose((0, y, 0)) @ b.pose) for b in row]) for y in (0, 0.1, 0.2)]
    figure = cs.plot([sim.step(s) for s in moved], sim, scenes=moved)
    figure.draw_without_rendering()
    seen = set()
    for axes in figure.axes:
        boxes = [text.get_window_extent() for text in axes.texts]
        seen |= {text.get_text() for text in axes.texts}
        for k, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:k])
    assert written <= seen
    told = {t.get_text() for legend in figure.legends for t in legend.get_texts()}
    assert told - {"start", "body at the largest change"} == listed
