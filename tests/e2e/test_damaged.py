"""Damaged and hostile files: readers raise their own named errors, soon, and nothing else."""

from __future__ import annotations

import contextlib
import io
import json
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mcap.writer
import meshio
import numpy as np
import pytest
import recorded_scenes
import scipy.io
from ball_scenario import ball_scenario
from mutations import mutations
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense import errors
from capsense import mesh as mesh_io
from capsense.__main__ import main
from capsense.design import load_design
from capsense.design.stl import read_stl
from capsense.mesh import TetMesh, kuhn_tets, load_mesh, save_mesh
from capsense.readout import recording as tables
from capsense.recording import files
from capsense.server import pack_depth, unpack_depth
from capsense.server.messages import parse, read_scene

DATA = Path(__file__).parents[1] / "data"
LONGEST = 1000


class Format(NamedTuple):
    """A kind of file."""

    sound: bytes
    name: str
    read: Callable[[Path], Any]
    errors: type[Exception] | tuple[type[Exception], ...]


def lattice() -> TetMesh:
    """48 tetrahedra with groups."""
    grid = kuhn_tets(*[np.linspace(0.0, 0.1, 3)] * 3)
    return grid.with_groups(
        node_groups={"E1": [0, 1, 2], "ground": [5, 6]}, cell_groups={"a": [0, 1]}
    )


def mesh_file(folder: Path, kind: str) -> Format:
    """A mesh: ``msh``, ``msh 2.2``, ``vtu``, ``vtu text``, ``mat`` or ``mat uncompressed``."""
    suffix, _, variant = kind.partition(" ")
    path = folder / f"sound.{suffix}"
    save_mesh(lattice(), path, msh_version="2.2" if variant == "2.2" else "4.1")
    if variant == "text":
        with warnings.catch_warnings(action="ignore"), contextlib.redirect_stdout(io.StringIO()):
            meshio.read(path).write(path, binary=False)
    if variant == "uncompressed":
        data = scipy.io.loadmat(path)
        scipy.io.savemat(path, {k: v for k, v in data.items() if not k.startswith("_")})
    return Format(path.read_bytes(), path.name, load_mesh, errors.MeshError)


def recording_file(folder: Path, kind: str) -> Format:
    """A recording of bodies, a mesh and a depth frame, as it is written or uncompressed."""
    writer = mcap.writer.Writer
    plain = {"compression": mcap.writer.CompressionType.NONE, "enable_crcs": False}
    with pytest.MonkeyPatch.context() as patch:
        if kind == "mcap uncompressed":
            patch.setattr(mcap.writer, "Writer", lambda file, **_: writer(file, **plain))
        sensor = cs.Simulator(tiny_design(), settings=SETTINGS)
        with cs.record(folder / "a.mcap", sensor, readout="fdc1004") as run:
            for k in range(3):
                run.step(recorded_scenes.scene_at(k), 0.1 * k)
            run.step(recorded_scenes.frame_at(0), 0.4)
    sound = (folder / "a.mcap").read_bytes()
    return Format(
        sound, "a.mcap", lambda path: list(cs.open_recording(path).steps()), errors.RecordingError
    )


def table_file(folder: Path, kind: str) -> Format:
    """What ``capsense run`` writes."""
    scenario = folder / "ball.toml"
    scenario.write_text(ball_scenario())
    assert main(["run", str(scenario), "-o", str(folder / "run"), "-q"]) == 0
    name = f"readings.{kind}"
    sound = (folder / "run" / name).read_bytes()
    return Format(sound, name, tables.load_recording, errors.ReadoutError)


READOUT = b"""
chip = "fdc1004"
rate = 400.0
capdac = 0
[wiring]
trace = 4e-12
[noise]
white = 7e-16
[climate]
temperature = [[0.0, 22.0], [3600.0, 27.0]]
[detector]
touch = 20000
release = 12000
[calibration]
gain = [1.02, 1.0]
offset = 2e-13
"""
SCENE = {
    "type": "scene", "sensor": 0, "sequence": 1, "time": 0.5,
    "body": [{"name": "b", "shape": "sphere", "radius": 0.02, "material": "steel",
              "pose": {"position": [0.0, 0.0, 0.05]}}],
}  # fmt: skip


def text_file(_: Path, kind: str) -> Format:
    """Files and messages that people and programs write."""
    six = Path(cs.load_design.__code__.co_filename).parent
    match kind:
        case "design":
            (path,) = six.rglob("six_patch.toml")
            return Format(path.read_bytes(), "a.toml", load_design, errors.DesignError)
        case "scenario":
            wrong = errors.ScenarioError, errors.DesignError
            return Format(ball_scenario().encode(), "a.toml", cs.load_scenario, wrong)
        case "readout":
            return Format(
                READOUT, "a.toml", lambda p: cs.load_readout(p, ("A", "B")), errors.ReadoutError
            )
        case "stl":
            sound = (DATA / "original_meshes/stripe_geom.stl").read_bytes()
            return Format(sound, "a.stl", read_stl, errors.DesignError)
        case "depth message":
            sound = pack_depth(0, 1, 0.5, np.ones((4, 5), np.float32), np.ones((4, 5), np.uint8))
            return Format(
                sound, "m", lambda p: unpack_depth(p.read_bytes(), 400), errors.ProtocolError
            )

    def scene(path: Path) -> Any:
        return read_scene(parse(path.read_text("utf-8", "replace")), 10)

    wrong = errors.ProtocolError, errors.ScenarioError
    return Format(json.dumps(SCENE).encode(), "m", scene, wrong)


FORMATS = {
    **dict.fromkeys(
        ("msh", "msh 2.2", "vtu", "vtu text", "mat", "mat uncompressed"), mesh_file
    ),
    **dict.fromkeys(("mcap", "mcap uncompressed"), recording_file),
    **dict.fromkeys(("npz", "csv"), table_file),
    **dict.fromkeys(
        ("design", "scenario", "readout", "stl", "depth message", "scene message"), text_file
    ),
}  # fmt: skip


def check(folder: Path, kind: str, count: int, seed: int) -> None:
    """Read that many damaged files: each is read, or refused by name in few words."""
    form = FORMATS[kind](folder, kind)
    path = folder / "damaged" / form.name
    path.parent.mkdir()
    path.write_bytes(form.sound)
    form.read(path)
    refused = []
    for content in mutations(form.sound, count, seed):
        path.write_bytes(content)
        with warnings.catch_warnings(action="ignore"):
            try:
                form.read(path)
            except form.errors as error:
                refused.append(len(str(error)))
    assert len(refused) > 0.3 * count
    assert max(refused) <= LONGEST


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files(tmp_path: Path, kind: str) -> None:
    """500 mutations of each format."""
    check(tmp_path, kind, 500, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_many_more_damaged_files(tmp_path: Path, kind: str) -> None:
    """20,000 mutations of each format."""
    check(tmp_path, kind, 20_000, seed=2)


@pytest.mark.parametrize("number", [14, 8, 11, 2**31 - 1])
def test_numbers_of_an_unknown_type_in_a_mat_file(tmp_path: Path, number: int) -> None:
    """They ended the process in SciPy's reader."""
    sound = mesh_file(tmp_path, "mat uncompressed").sound
    at = sound.index(struct.pack("<II", 9, 27 * 3 * 8))
    path = tmp_path / "a.mat"
    path.write_bytes(sound[:at] + struct.pack("<I", number) + sound[at + 4 :])
    with pytest.raises(errors.MeshError, match=r"unknown type|cut off"):
        load_mesh(path)


def test_files_that_inflate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What would take up more memory than a limit is not unpacked."""
    for module in (mesh_io, tables, files):
        monkeypatch.setattr(module, "_MOST", 1000)
    form = mesh_file(tmp_path, "mat")
    with pytest.raises(errors.MeshError, match="inflates to more than 1,000 bytes"):
        load_mesh(tmp_path / form.name)
    table_file(tmp_path, "npz")
    with pytest.raises(errors.ReadoutError, match="bytes of memory"):
        tables.load_recording(tmp_path / "run")
    form = recording_file(tmp_path, "mcap")
    with pytest.raises(errors.RecordingError, match="bytes of memory"):
        form.read(tmp_path / "a.mcap")
    (tmp_path / "a.vtu").write_text('<VTKFile compressor="vtkLZMADataCompressor">')
    with pytest.raises(errors.MeshError, match="LZMA"):
        load_mesh(tmp_path / "a.vtu")


def chunk_of(path: Path, zeros: bytes, told: int) -> Path:
    """A recording of one chunk, which says that it inflates to ``told`` bytes."""
    import zstandard

    data = zstandard.compress(zeros)
    head = struct.pack("<QQQI", 0, 0, told or len(zeros), zlib.crc32(zeros) if told else 0)
    chunk = head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    path.write_bytes(files.MAGIC + struct.pack("<BQ", 6, len(chunk)) + chunk)
    return path


@pytest.mark.parametrize("told", [0, 100])
def test_a_chunk_of_zeros(tmp_path: Path, told: int) -> None:
    """Ten million records without content, in some kilobytes; told to be smaller than it is."""
    path = chunk_of(tmp_path / "a.mcap", bytes(90_000_000), told)
    with pytest.raises(errors.RecordingError, match="a record of kind 0"):
        cs.open_recording(path)


def test_a_chunk_that_says_too_little(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is on what it inflates to, not on what it says."""
    monkeypatch.setattr(files, "_MOST", 1000)
    path = chunk_of(tmp_path / "a.mcap", bytes(5000), 100)
    with pytest.raises(errors.RecordingError, match="5,000 bytes of memory"):
        cs.open_recording(path)


@pytest.mark.parametrize("kind", ["design", "scenario", "readout"])
def test_deep_files(tmp_path: Path, kind: str) -> None:
    """Brackets within brackets, deeper than the parser can go."""
    form = FORMATS[kind](tmp_path, kind)
    path = tmp_path / form.name
    path.write_text("a = " + "[" * 100_000)
    with pytest.raises(form.errors, match="not valid TOML"):
        form.read(path)


@pytest.mark.parametrize("number", ["9" * 400, "9" * 5000, "0x" + "f" * 5000])
def test_numbers_without_end(tmp_path: Path, number: str) -> None:
    """Integers that no float holds, and that Python refuses to print."""
    for kind, key in (("scenario", "sample_rate"), ("scenario", "excitation"), ("design", "name")):
        form = FORMATS[kind](tmp_path, kind)
        path = tmp_path / form.name
        path.write_text(f"{key} = {number}\n")
        with pytest.raises(form.errors):
            form.read(path)
    for make in (cs.Sphere, cs.OrthographicCamera, lambda n: cs.Material("m", n)):
        with pytest.raises(errors.SceneError):
            make(10**400)


def test_messages_stay_short() -> None:
    """The beginning names the thing, the end tells what to do."""
    with pytest.raises(errors.SceneError) as caught:
        cs.Pose([0.0] * 3, "x" * 50_000)
    text = str(caught.value)
    assert len(text) <= LONGEST
    assert text.startswith("quaternion is")
    assert text.endswith("give four numbers in the order (x, y, z, w)")
