"""The Unity package: compiled with mcs against a stub, run under mono against the real server."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')

from hypothesis import given, settings
from hypothesis import strategies as st
from running_server import RunningServer

import capsense as cs
from capsense.bench import moving_depth
from capsense.humans import Build, TrackedHand
from capsense.server.messages import MessageTable, read_hands
from capsense.simulator import Simulator

HERE = Path(__file__).parent
PACKAGE = HERE.parents[2] / "unity"
TIMEOUT = 120
"""Longest time that a run may take [s]."""

needs_mono = pytest.mark.skipif(
    not (shutil.which("mcs") and shutil.which("mono")),
    reason="needs mono: apt-get install mono-mcs mono-runtime",
)


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, its sample, the stub and the driver, compiled without a warning."""
    sources = [*HERE.glob("*.cs"), *PACKAGE.rglob("*.cs")]
    target = tmp_path_factory.mktemp("unity") / "driver.exe"
    compile_sources(f"-out:{target}", *map(str, sources))
    return target


def compile_sources(*words: str) -> None:
    """Run the compiler; warnings are errors."""
    command = ["mcs", "-langversion:7.2", "-warn:4", "-warnaserror", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def served() -> Any:
    """A server of six patches."""
    with RunningServer("six_patch") as server:
        yield server


def run(program: Path, *words: str, told: str | None = None) -> list[dict[str, Any]]:
    """The lines that the driver prints for a task, and what it was told."""
    done = subprocess.run(
        ["mono", str(program), *words], capture_output=True, text=True, timeout=TIMEOUT, input=told
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def matrix(flat: list[float]) -> np.ndarray:
    """A matrix of six electrodes."""
    return np.array(flat).reshape(6, 6)


@needs_mono
def test_client_needs_the_base_library_alone(tmp_path: Path) -> None:
    """It compiles without anything of Unity's."""
    client = ("CapSenseClient", "RemoteSensor", "Wire", "Json", "HandFrame")
    sources = [str(PACKAGE / "Runtime" / f"{name}.cs") for name in client]
    compile_sources("-target:library", f"-out:{tmp_path / 'client.dll'}", *sources)


@needs_mono
def test_frames_out_readings_back(program: Path, served: RunningServer) -> None:
    """Every number of the readings is the simulator's, for frames that move."""
    simulator = Simulator("six_patch")
    *lines, times = run(program, "steps", served.url, "30")
    assert [line["sequence"] for line in lines] == [0, 1, 2, 29]
    for line in lines[:3]:
        k = line["sequence"]
        depth = moving_depth(k).depth[0].astype(np.float32)
        here = simulator.step(cs.DepthFrame(np.where(np.isfinite(depth), depth, 0), "steel"))
        assert line["time"] == 0.01 * k
        # The depths agree to a few units of float32.
        assert matrix(line["delta"]) == approx(here.delta, rel=1e-4)
        assert line["self"] == approx(here.self_capacitance, rel=1e-6)
        assert np.array_equal(matrix(line["baseline"]), simulator.baseline)
        assert tuple(line["electrodes"]) == simulator.electrode_names
        assert (line["channels"], line["codes"], line["dropped"]) == ([], [], 0)
    assert len(times["round_trip_s"]) == 27


@needs_mono
def test_permittivity_codes(program: Path, served: RunningServer) -> None:
    """Codes arrive pixel by pixel, and the assumed thickness."""
    (line,) = run(program, "codes", served.url)
    depth = moving_depth(0).depth[0].astype(np.float32)
    codes = np.where(np.arange(64 * 64) < 2048, 4, 255).astype(np.uint8).reshape(64, 64)
    here = Simulator("six_patch").step(cs.DepthFrame(depth, codes, back=0.05)).delta
    assert matrix(line["delta"]) == approx(here, rel=1e-4)


@needs_mono
def test_readout(program: Path) -> None:
    """Conversions of a chip arrive."""
    with RunningServer(readout="fdc1004") as server:
        *lines, _ = run(program, "steps", server.url, "30")
    assert len(lines[0]["channels"]) == 6
    assert all(isinstance(code, int) for line in lines for code in line["codes"])
    assert lines[-1]["codes"]


@needs_mono
def test_mistakes(program: Path, served: RunningServer) -> None:
    """A frame too large and an unknown design fail by name; the connection stays."""
    assert run(program, "mistakes", served.url) == [
        {"code": "limit"}, {"code": "scene"}, {"sequence": 1, "state": "Connected"},
    ]  # fmt: skip


@needs_mono
def test_tokens_and_versions(program: Path) -> None:
    """A wrong token or version is final: the client says so and does not try again."""
    with RunningServer(token="correct horse") as server:
        for words, code, state in (
            (("correct horse",), "none", "Connected"),
            (("wrong horse",), "token", "Refused"),
            (("correct horse", "99"), "version", "Refused"),
        ):
            assert run(program, "hello", server.url, *words) == [{"code": code, "state": state}]
        assert len(server.logged("connected")) == 3


@needs_mono
def test_reconnection(program: Path) -> None:
    """A server that goes and comes back finds the client there again, its sensor opened anew."""
    first = RunningServer().__enter__()
    with subprocess.Popen(
        ["mono", str(program), "stay", first.url], stdout=subprocess.PIPE, text=True
    ) as process:
        guard = threading.Timer(TIMEOUT, process.kill)
        guard.start()
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["event"] == "readings"
        first.stop()
        assert json.loads(process.stdout.readline()) == {"event": "lost"}
        with RunningServer(port=first.port):
            again = json.loads(process.stdout.readline())
            assert (again["event"], len(again["electrodes"])) == ("readings", 6)
            assert process.wait(TIMEOUT) == 0
        guard.cancel()


@needs_mono
@pytest.mark.parametrize("depth_buffer", ["reversed", "plain"])
def test_component(program: Path, served: RunningServer, depth_buffer: str) -> None:
    """What stands above, to the right of the component is felt by the electrode there.

    Unity's right is the design's −x, so that is E4; and it is as strong as the same box is for
    the simulator, whose halves have the permittivities that the red channel tells.
    """
    first, last = run(program, "component", served.url, depth_buffer)
    x, y = np.meshgrid((np.arange(64) + 0.5) / 128 - 0.25, (np.arange(64) + 0.5) / 128 - 0.25)
    box = (np.abs(x + 0.06) < 0.03) & (np.abs(y - 0.05) < 0.03)
    codes = np.where(x > -0.06, 3, 9).astype(np.uint8)
    here = Simulator("six_patch").step(cs.DepthFrame(np.where(box, 0.06, 0.0), codes)).delta
    assert np.argmax(np.diag(matrix(first["delta"]))) == 3
    assert matrix(first["delta"]) == approx(here, rel=1e-3)
    assert first["received"] == 3
    assert 0 < first["time"] < 0.5 * TIMEOUT
    assert last == {"state": "Stopped"}


@needs_mono
def test_settings_of_the_component(program: Path, served: RunningServer) -> None:
    """No address is an error told once; a field that changes is taken over; all is cleaned up.

    While an answer is waited for nothing is rendered; what touches the sensor is felt.
    """
    wrong, seen, again, last = run(program, "settings", served.url)
    (error,) = wrong["errors"]
    assert "is no address of a server" in error
    assert wrong["cameras"] == 0
    assert 0 <= seen["rendered"] - seen["sequence"] - 1 <= 1
    assert seen["self"] > 1e-12
    assert again == {"cameras": 2, "textures": 2}
    assert last == {"state": "Stopped", "quick": True}


@needs_mono
def test_silent_server(program: Path) -> None:
    """One that takes frames and never answers is given up."""
    from websockets.sync.server import serve

    def handle(connection: Any) -> None:
        connection.recv()
        connection.send(json.dumps({"type": "welcome"}))
        sensor = json.loads(connection.recv())["sensor"]
        opened = {"type": "opened", "sensor": sensor, "baseline": [[1.0]], "channels": [],
                  "electrodes": ["E1"]}  # fmt: skip
        connection.send(json.dumps(opened))
        for _ in connection:
            pass

    with serve(handle, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        assert run(program, "silent", url) == [{"code": "closed"}]
        server.shutdown()


@needs_mono
def test_sample(program: Path, served: RunningServer) -> None:
    """A bar for each electrode, as high as its signal."""
    (line,) = run(program, "sample", served.url)
    assert tuple(line["names"]) == Simulator("six_patch").electrode_names
    own = np.diag(matrix(line["delta"]))
    assert own.min() > 1e-15
    assert line["heights"] == approx(np.maximum(own / 1e-12, 0.001), rel=1e-6)


@needs_mono
@pytest.mark.parametrize("skin", [False, True])
def test_hands(program: Path, served: RunningServer, skin: bool) -> None:
    """Joints of XR Hands, in its order and Unity's axes, are sensed as the same hand here.

    The sensor and the XR Origin stand anywhere; a joint is missing, and the left hand.
    """
    rng = np.random.default_rng(4)
    model = TrackedHand(Build("female"), "right", "openxr", "skin" if skin else "inside")
    down = cs.Pose.from_matrix(np.stack([(0, 1, 0), (0, 0, -1), (-1, 0, 0)], axis=1))
    joints = model.joints({"index_pip_flexion": 0.5}, cs.Pose((-0.1, 0, 0.04)) @ down)
    sensor, origin = (cs.Pose(rng.uniform(-1, 1, 3), rng.normal(size=4)) for _ in range(2))
    unity = origin.inverse().apply(sensor.apply(joints * (-1, 1, 1)))
    hidden = 6  # the metacarpal of the index finger, which no landmark is
    order = [1, 0, *range(2, 26)]  # of XR Hands: wrist, palm, …
    told = {
        "position": sensor.position, "rotation": sensor.quaternion, "origin": origin.position,
        "turn": origin.quaternion, "skin": skin,
        "joints": [None if k == hidden else unity[k].tolist() for k in order],
    }  # fmt: skip
    idle, message, reading, last = run(program, "hands", served.url, told=json.dumps(told))
    assert idle == {"type": "hands", "sensor": 3, "sequence": 4, "time": 0.5, "hands": []}
    (hand,) = message["hands"]
    assert (hand["side"], hand["convention"], hand["confidence"]) == ("right", "openxr", 1)
    assert hand["joints"][hidden] is None
    found = np.array([[np.nan] * 3 if p is None else p for p in hand["joints"]])
    joints[hidden] = np.nan
    np.testing.assert_allclose(found, joints, atol=2e-6)  # float32 at a metre from the origin
    seen = read_hands(MessageTable(message, "message", "hands")).hands[0]
    bodies = model.bodies(model.landmarks(seen.joints, seen.radii), conductor="hands")
    here = Simulator("six_patch").step(cs.Scene(bodies)).delta
    assert here[1, 1] > 1e-14
    assert matrix(reading["delta"]) == approx(here, rel=1e-9)
    assert reading["state"] == "Connected"
    assert last == {"state": "Stopped"}


def test_the_assembly_of_hands_is_optional() -> None:
    """It is compiled where XR Hands is installed, and only there."""
    folder = PACKAGE / "Runtime" / "Hands"
    made = json.loads((folder / "CapSense.Hands.asmdef").read_text())
    assert set(made["references"]) == {"CapSense", "Unity.XR.Hands"}
    (define,) = made["versionDefines"]
    assert define["name"] == "com.unity.xr.hands"
    assert made["defineConstraints"] == [define["define"]]
    others = [p for p in (PACKAGE / "Runtime").glob("*.cs") if "XR.Hands" in p.read_text()]
    assert others == []


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**31), 2**31)
    | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
    | st.text(max_size=12),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4)
    ),
    max_leaves=10,
)


@needs_mono
def test_json(program: Path) -> None:
    """What Python writes is read and written again unchanged; what is no JSON is refused."""
    values: list[Any] = []

    @given(json_values)
    @settings(max_examples=200, database=None)
    def collect(value: Any) -> None:
        values.append(value)

    collect()
    wrong = ["", "{", "[1,]", '{"a" 1}', '"a', "tru", "1 2", "nul", "--1", '"\\x"', "[" * 100]
    text = "\n".join([*map(json.dumps, values), *wrong])
    done = subprocess.run(
        ["mono", str(program), "json"], input=text, capture_output=True, text=True, timeout=TIMEOUT
    )
    lines = done.stdout.split("\n")[:-1]
    assert lines[len(values) :] == ["error"] * len(wrong)
    assert all(same(json.loads(line), v) for line, v in zip(lines, values, strict=False))


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal; mono's numbers are off by a unit in the last place at times."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-15)
    return a == b


def test_package_is_whole() -> None:
    """The manifest fits the library, and every asset has an identity of its own."""
    manifest = json.loads((PACKAGE / "package.json").read_text())
    assert re.fullmatch(r"[a-z]+(\.[a-z]+)+", manifest["name"])
    assert manifest["version"] == cs.__version__
    assert f"## [{manifest['version']}]" in (PACKAGE / "CHANGELOG.md").read_text()
    for sample in manifest["samples"]:
        (scene,) = (PACKAGE / sample["path"]).glob("*.unity")
        (script,) = (PACKAGE / sample["path"]).glob("*.cs")
        identity = script.with_name(script.name + ".meta").read_text().split("guid: ")[1].strip()
        assert f"guid: {identity}" in scene.read_text()
    shaders = {
        re.findall(r'^Shader "(.+)"', p.read_text(), re.MULTILINE)[0]
        for p in PACKAGE.rglob("*.shader")
    }
    used = re.findall(r'Shader.Find\("(.+)"\)', (PACKAGE / "Runtime/DepthCamera.cs").read_text())
    assert set(used) <= shaders
    sample_files = [p for p in PACKAGE.rglob("*") if "Samples~/Hand/" in p.as_posix()]
    assets = [p for p in PACKAGE.rglob("*") if "~" not in str(p)] + sample_files
    assets = [p for p in assets if p.suffix != ".meta"]
    identities = set()
    for asset in assets:
        meta = asset.with_name(asset.name + ".meta")
        found = re.search(r"^guid: ([0-9a-f]{32})$", meta.read_text(), flags=re.MULTILINE)
        assert found, meta
        identities.add(found[1])
    assert len(identities) == len(assets)
    assert len(list(PACKAGE.rglob("*.meta"))) == len(assets)
