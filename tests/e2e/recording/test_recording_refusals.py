"""What a recorder refuses, and that it does so before anything is computed."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import recorded_scenes
from approximate import approx

import capsense as cs
from capsense.errors import MissingDependencyError, ReadoutError, RecordingError
from capsense.scene import Shape
from capsense.solver.surface_solver import SurfaceSolver


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def scene(k: int = 0) -> cs.Scene:
    return recorded_scenes.scene_at(k)


@pytest.mark.parametrize("source", [3, "six_patch", cs.load_design("six_patch")])
def test_what_reads_nothing(path: Path, source: object) -> None:
    """Neither a simulator nor a sensor; no file is begun."""
    with pytest.raises(TypeError, match=r"source is of \w+; give a Simulator, or a sensor"):
        cs.record(path, source)  # type: ignore[arg-type]
    assert not path.exists()


def test_steps_behind_the_recorders_back(sim: cs.Simulator, path: Path) -> None:
    """They would change the last digits of what follows; a reset puts it right."""
    with cs.record(path, sim) as run:
        run.step(scene(), 0.0)
        sim.step(scene(1))
        with pytest.raises(RecordingError, match="after number 1 that was not recorded"):
            run.step(scene(), 0.1)
        assert sim.steps == 2
        sim.reset()
        run.step(scene(), 0.0)
        run.step(scene(2), 0.1)
    assert [s.episode for s in cs.open_recording(path).steps()] == [0, 1, 1]
    assert cs.replay(path).same


def test_a_loop_that_steps_the_simulator_itself(sim: cs.Simulator, path: Path) -> None:
    with cs.record(path, sim) as run:
        sim.reset()
        run.write(0.0, scene(), sim.step(scene()))
        sim.step(scene(1))
        reading = sim.step(scene(2))
        with pytest.raises(RecordingError, match="not recorded"):
            run.write(0.1, scene(2), reading)
    assert cs.replay(path).steps == 1


def test_a_step_that_fails_needs_a_reset(
    sim: cs.Simulator, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a failed step leaves in the solver is not known to a replay."""

    def fail(*_: object, **__: object) -> None:
        raise cs.SolveError("the residual is 1e-3")

    with cs.record(path, sim) as run:
        run.step(scene(), 0.0)
        with monkeypatch.context() as patch:
            patch.setattr(SurfaceSolver, "solve", fail)
            with pytest.raises(cs.SolveError):
                run.step(scene(1), 0.1)
        with pytest.raises(RecordingError, match="reset"):
            run.step(scene(1), 0.1)
        run.reset()
        run.step(scene(1), 0.1)
    assert cs.replay(path).same


@pytest.mark.parametrize("time", [-1.0, math.nan, math.inf, 1e10])
def test_times(sim: cs.Simulator, path: Path, time: float) -> None:
    with cs.record(path, sim) as run, pytest.raises(RecordingError, match="zero or more"):
        run.step(scene(), time)
    assert sim.steps == 0


def test_time_goes_on(sim: cs.Simulator, path: Path) -> None:
    """Time may stand still, not go back; after a reset it may start anew, or go on as it was."""
    with cs.record(path, sim) as run:
        run.step(scene(), 1.0)
        run.step(scene(), 1.0)
        with pytest.raises(
            RecordingError, match=r"0.5 s, but the last step was at 1 s; call reset"
        ):
            run.step(scene(), 0.5)
        run.reset()
        run.step(scene(), 1.5)
        run.reset()
        run.step(scene(), 0.25)
        run.step(scene(), 0.5)
    steps = list(cs.open_recording(path).steps())
    assert [s.stamp / 1e9 for s in steps] == [1.0, 1.0, 1.5, 3.0, 3.25]
    assert [s.time for s in steps] == [1.0, 1.0, 1.5, 0.25, 0.5]
    assert [s.clock for s in steps] == approx([1.0, 1.0, 1.5, 3.0, 3.25], abs=1e-12)


def test_places(sim: cs.Simulator, tmp_path: Path) -> None:
    taken = tmp_path / "taken.mcap"
    taken.write_text("mine")
    with pytest.raises(RecordingError, match="there already"):
        cs.record(taken, sim)
    assert taken.read_text() == "mine"
    cs.record(taken, sim, overwrite=True).close()
    assert cs.open_recording(taken).complete
    for place in (tmp_path, tmp_path / "no" / "a.mcap", Path("/dev/full/a.mcap")):
        with pytest.raises(RecordingError, match=r"cannot be written|there already"):
            cs.record(place, sim)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission(sim: cs.Simulator, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match="Permission"):
        cs.record(tmp_path / "a.mcap", sim)


def test_names_and_readouts(
    sim: cs.Simulator, path: Path, simulators: Callable[..., cs.Simulator]
) -> None:
    for name in ("", "a b", "/tf", "1st"):
        with pytest.raises(RecordingError, match="letters"):
            cs.record(path, sim, name=name)
    with pytest.raises(ReadoutError, match="fdc1004"):
        cs.record(path, sim, readout="fdc1040")
    with pytest.raises(ReadoutError, match="there is no"):
        cs.record(path, sim, readout=path.with_suffix(".toml"))
    assert not path.exists()
    with cs.record(path, sim) as run, pytest.raises(RecordingError, match="write step"):
        run.read()


def test_a_shape_that_messages_do_not_have(sim: cs.Simulator, path: Path) -> None:
    class Blob(cs.Sphere):
        pass

    class Odd(Shape):
        kind = cs.Sphere.kind
        params = cs.Sphere(0.01).params
        volume = 1.0

        def bounds(self) -> object:
            return cs.Sphere(0.01).bounds()

        signed_distance = to_trimesh = _measured_in = None

    with cs.record(path, sim) as run:
        run.step(cs.Scene([cs.Body(Blob(0.01), cs.Pose((0, 0, 0.05)))]), 0.0)
        with pytest.raises(RecordingError, match="cannot be recorded"):
            run.step(cs.Scene([cs.Body(Odd(), cs.Pose((0, 0, 0.05)))]), 0.1)
        run.reset()
        run.step(scene(), 0.0)
    assert cs.replay(path).steps == 2


@pytest.mark.parametrize("package", ["mcap.writer", "rosbags.typesys"])
def test_missing_packages(
    sim: cs.Simulator, path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    for call in (lambda: cs.record(path, sim), lambda: cs.open_recording(path)):
        with pytest.raises(MissingDependencyError, match=r"pip install 'capsense\[record\]'"):
            call()


def test_a_readout_of_ones_own(sim: cs.Simulator, path: Path) -> None:
    """Its counts are recorded; what it was made of is not known, so a replay leaves them out."""
    own = cs.Readout.preset("ad7147", sim.electrode_names, seed=5)
    with cs.record(path, sim, readout=own) as run:
        first = [run.step(scene(k), 0.1 * k).counts for k in range(3)]
        run.reset()
        again = [run.step(scene(k), 0.1 * k).counts for k in range(3)]
    assert [c.code.tolist() for c in again if c] == [c.code.tolist() for c in first if c]
    found = cs.replay(path)
    held = sum(len(c) for c in first + again if c)
    assert (found.counts, found.recorded_counts) == (None, held)
    assert f"{held} recorded, not compared" in str(found)
    with cs.record(path, sim, overwrite=True) as run:
        run.step(scene(0), 0.0)
    plain = cs.replay(path)
    assert (plain.counts, plain.recorded_counts) == (None, 0)
    assert "conversions" not in str(plain)


def test_a_chip_by_name_is_set_up_for_the_electrodes(sim: cs.Simulator, path: Path) -> None:
    """An MPR121 is in range, in the recording as in its replay."""
    with cs.record(path, sim, readout="mpr121") as run:
        counts = [run.step(cs.Scene(), 0.1 * k).counts for k in range(4)]
    flags = np.concatenate([c.flags for c in counts if c is not None])
    assert len(flags) > 6
    assert not flags.any()
    assert cs.replay(path).same


def test_a_readout_file(sim: cs.Simulator, path: Path, tmp_path: Path) -> None:
    """A replay builds it again from the recording; the file may be gone."""
    file = tmp_path / "chip.toml"
    file.write_text('chip = "mpr121"\nseed = 3\n[detector]\ntouch = 5\nrelease = 2\n')
    with cs.record(path, sim, readout=file) as run:
        for k in range(8):
            run.step(scene(k), 0.1 * k)
    file.unlink()
    found = cs.replay(path)
    assert found.same
    assert found.counts
    assert found.counts == found.recorded_counts
    assert f"conversions  {found.counts}\n" in str(found)
    steps = list(cs.open_recording(path).steps())
    assert any(s.reading.counts is not None and s.reading.counts.touched is not None for s in steps)


def test_without_mcap_the_extra_is_named() -> None:
    """Regression: the import of ``mcap`` failed, without a fix."""
    code = (
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'mcap':\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Missing())\n"
        "import capsense as cs\n"
        "try:\n"
        "    cs.record\n"
        "except cs.MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "pip install 'capsense[record]'" in done.stdout, done.stderr
