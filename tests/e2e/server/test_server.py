"""The server and its Python client: readings are those of the simulator, whoever else is there."""

from __future__ import annotations

import copy
import threading

import numpy as np
import pytest
from running_server import WAIT, RunningServer, wait_for

import capsense as cs
from capsense.errors import CapSenseError, ProtocolError, ServerError
from capsense.server.options import Limits, ServerOptions
from capsense.server.sensor import ServedSensor
from capsense.server.server import Server
from capsense.simulator import Simulator

TOKEN = "correct horse"


def test_readings_are_the_simulators(served: RunningServer, dome: np.ndarray) -> None:
    """A series of frames gives, to the last bit, what a simulator gives for it."""
    simulator = Simulator("six_patch")
    with served.client() as client:
        sensor = client.open(material="human")
        assert sensor.electrode_names == simulator.electrode_names
        assert np.array_equal(sensor.baseline, simulator.baseline)
        assert np.array_equal(sensor.domain[1], simulator.design.domain.upper)
        for k in range(4):
            frame = np.roll(dome, k, axis=0)
            here = simulator.step(cs.DepthFrame(frame, "human"))
            there = sensor.step(frame, time=0.1 * k)
            assert (there.sequence, there.time, there.dropped) == (k, 0.1 * k, 0)
            assert np.array_equal(there.capacitance, here.capacitance)
            assert np.array_equal(there.delta, here.delta)
            assert np.array_equal(there.self_capacitance, here.self_capacitance)
            assert there.iterations == here.stats.iterations
            assert not len(there.conversions)


def test_welcome(served: RunningServer) -> None:
    """What a server tells of itself."""
    with served.client() as client:
        assert client.welcome == {
            "type": "welcome", "protocol": 1, "server": f"capsense {cs.__version__}",
            "designs": ["six_patch", "patch"],
            "limits": {"sensors": 8, "pixels": 65536, "bodies": 64, "message": 40 + 8 * 65536},
            "touch": True, "hands": True,
        }  # fmt: skip


def test_permittivities_and_cameras(served: RunningServer, dome: np.ndarray) -> None:
    """Codes, numbers, thickness, grounding and camera arrive."""
    codes = np.where(np.arange(32) < 16, 4, 255).astype(np.uint8) * np.ones((32, 1), np.uint8)
    numbers = np.where(codes == 255, np.inf, 3.5)
    camera = cs.OrthographicCamera(0.3, 0.4, cs.Pose((0.01, 0, 0.02)), rows="-y", columns="-x")
    simulator = Simulator("patch")
    with served.client() as client:
        sensor = client.open(
            design="patch", grounding="floating", back=0.02,
            camera={"width": 0.3, "height": 0.4, "rows": "-y", "columns": "-x",
                    "pose": {"position": [0.01, 0, 0.02]}},
        )  # fmt: skip
        for eps_r in (codes, numbers):
            frame = cs.DepthFrame(dome, eps_r, camera, grounding="floating", back=0.02)
            here = simulator.step(frame).delta
            assert np.array_equal(sensor.step(dome, eps_r).delta, here)


def test_scenes_and_poses(served: RunningServer, dome: np.ndarray) -> None:
    """Bodies, then their poses, then pixels again: one sensor, one series."""
    simulator = Simulator("six_patch")
    ball = cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.06)), "water", name="ball")
    wall = cs.Body(cs.Box((0.1, 0.1, 0.1)), cs.Pose((0, 0, 0.2)), "steel", name="wall")
    tables = [
        {"name": "ball", "shape": "sphere", "radius": 0.03, "material": "water",
         "pose": {"position": [0, 0, 0.06]}},
        {"name": "wall", "shape": "box", "size": [0.1, 0.1, 0.1], "material": "steel",
         "pose": {"position": [0, 0, 0.2]}},
    ]  # fmt: skip
    with served.client() as client:
        sensor = client.open()
        here = simulator.step(cs.Scene([ball, wall])).delta
        assert np.array_equal(sensor.step_scene(tables).delta, here)
        here = simulator.step(cs.Scene([ball.moved(cs.Pose((0.02, 0, 0.05))), wall])).delta
        moved = sensor.step_poses({"ball": {"position": [0.02, 0, 0.05]}})
        assert np.array_equal(moved.delta, here)
        with pytest.raises(ProtocolError, match="no body 'cup'; it has ball, wall") as caught:
            sensor.step_poses({"cup": {"position": [0, 0, 0.1]}})
        assert caught.value.code == "scene"
        here = simulator.step(cs.DepthFrame(dome)).delta
        assert np.array_equal(sensor.step(dome).delta, here)
        assert not sensor.step_scene([]).delta.any()


def test_several_sensors_and_clients(served: RunningServer, dome: np.ndarray) -> None:
    """Clients that work at once, with two sensors each, all read what they would alone."""
    alone = {
        name: Simulator(name).step(cs.DepthFrame(dome)).delta for name in ("six_patch", "patch")
    }
    results: list[bool] = []

    def work() -> None:
        with served.client() as client:
            sensors = [client.open(design=name) for name in alone]
            for _ in range(5):
                numbers = [s.send(dome) for s in sensors]
                for sensor, number in zip(sensors, numbers, strict=True):
                    delta = client.reading(sensor.number, number).delta
                    results.append(np.allclose(delta, alone[sensor.design], rtol=1e-4, atol=1e-18))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT)
    assert results == [True] * 30


@pytest.mark.parametrize("given", ["name", "object"])
def test_readout(dome: np.ndarray, given: str) -> None:
    """Counts are those of the chip, between readings, from the first frame's time on."""
    simulator = Simulator("six_patch")
    readout = cs.Readout.preset("fdc1004", simulator.electrode_names)
    choice = "fdc1004" if given == "name" else copy.deepcopy(readout)
    with RunningServer(readout=choice) as server, server.client() as client:
        sensor, other = client.open(), client.open()
        assert sensor.channel_names == readout.channel_names
        times = 100.0 + 0.01 * np.arange(30)
        here, there = [], []
        readout.reset(start=100.0)
        for t in times:
            frame = np.roll(dome, int(t * 100) % 32, axis=1)
            here += readout.sample(t, simulator.step(cs.DepthFrame(frame))).code.tolist()
            there += sensor.step(frame, time=t).conversions["code"].tolist()
        assert len(there) > 5
        assert there == here
        readout.reset(start=0.0, seed=other.number * 2**32)  # noise of its own
        simulator.reset()
        for t in (0.0, 0.2):
            expected = readout.sample(t, simulator.step(cs.DepthFrame(dome))).code.tolist()
            assert other.step(dome, time=t).conversions["code"].tolist() == expected
        for t, words in ((1e12, "leaps"), (99.0, "must not go back")):
            with pytest.raises(ProtocolError, match=words) as caught:
                sensor.step(dome, time=t)
            assert caught.value.code == "readout"
        sensor.reset()
        assert sensor.step(dome, time=1e12).sequence == 0


def hold_solves(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Make every solve wait: events that tell that one has begun, and that let them go on."""
    begun, go = threading.Event(), threading.Event()
    solve = ServedSensor.solve

    def slow(self: ServedSensor, frame: object) -> bytes:
        begun.set()
        assert go.wait(WAIT)
        return solve(self, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(ServedSensor, "solve", slow)
    return begun, go


def test_newest_frame_wins(
    served: RunningServer, dome: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While one frame is solved, all that come but the last are dropped, and counted."""
    begun, go = hold_solves(monkeypatch)
    with served.client() as client:
        sensor = client.open()
        sensor.send(dome)
        assert begun.wait(WAIT)
        for _ in range(7):
            sensor.send(dome)
        other = client.open()  # handled after those seven
        go.set()
        assert client.reading(sensor.number, 0).dropped in (0, 6)
        assert client.reading(sensor.number, 7).dropped == 6
        other.close()
        assert sensor.close() == {"frames": 8, "readings": 2, "dropped": 6}


def test_frames_that_a_reset_or_the_end_overtakes(
    served: RunningServer, dome: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They count as dropped, and no reading of a sensor comes after it is closed."""
    begun, go = hold_solves(monkeypatch)
    with served.client() as client:
        busy, ended, restarted = client.open(), client.open(), client.open()
        busy.send(dome)
        assert begun.wait(WAIT)
        ended.send(dome)
        restarted.send(dome)
        assert ended.close() == {"frames": 1, "readings": 0, "dropped": 1}
        restarted.reset()
        go.set()
        assert client.reading(busy.number, 0).sequence == 0
        assert restarted.step(dome).dropped == 1
        assert restarted.close() == {"frames": 2, "readings": 1, "dropped": 1}
        assert not client.sensors[busy.number].kept
        with pytest.raises(ProtocolError, match="no answer"):
            client.receive(0.05)


def test_replayed_frames_are_refused(served: RunningServer, dome: np.ndarray) -> None:
    """A number that does not rise is an error, until a reset; other sensors have their own."""
    with served.client() as client:
        first, second = client.open(), client.open()
        first.step(dome)
        first.step(dome)
        for number in (1, 0):
            first.sequence = number
            with pytest.raises(
                ProtocolError, match=f"frame {number} comes after frame 1"
            ) as caught:
                first.step(dome)
            assert caught.value.code == "sequence"
        assert second.step(dome).sequence == 0
        first.sequence = 2**53 - 1
        assert first.step(dome).sequence == 2**53 - 1
        first.reset()
        assert first.step(dome).sequence == 0


def test_sensors_by_number(served: RunningServer, dome: np.ndarray) -> None:
    """Twice the same, one too many, none: refused by name; a closed one's number is free again."""
    with served.client() as client:
        client.open(5)
        with pytest.raises(ProtocolError, match="sensor 5 is open already"):
            client.open(5)
        with pytest.raises(ProtocolError, match="design 'six_pach' is not served; did you mean"):
            client.open(6, design="six_pach")
        client.sensors[5].close()
        with pytest.raises(ProtocolError, match="there is no sensor 5; open are none"):
            client.ask("reset", type="reset", sensor=5)
        for k in range(8):
            client.open(k)
        with pytest.raises(ProtocolError, match="8 sensors are open, as many as allowed") as caught:
            client.open(8)
        assert caught.value.code == "limit"


def test_token(dome: np.ndarray) -> None:
    """Only who says the token comes in; it is in no log."""
    with RunningServer(token=TOKEN) as server:
        for wrong in ("", "correct horsf", TOKEN + "x", "\N{HORSE}", "\ud800"):
            with pytest.raises(ProtocolError, match="token is missing or wrong") as caught:
                server.client(token=wrong)
            assert caught.value.code == "token"
        with server.client(token=TOKEN) as client:
            assert client.open().step(dome).sequence == 0
        assert server.get("/health")[0] == 200
        assert TOKEN not in str(server.events)
        assert TOKEN not in repr(server.server.options)


def test_origins() -> None:
    """Web pages come in where they are listed; programs, which send no origin, always do."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with RunningServer(origins=("http://localhost:3000",)) as server:
        connect(server.url, origin="http://localhost:3000").close()  # type: ignore[arg-type]
        connect(server.url).close()
        for origin in ("http://localhost:3001", "https://evil.example", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(server.url, origin=origin)  # type: ignore[arg-type]


def test_health_and_log(dome: np.ndarray) -> None:
    """What is going on, over HTTP on the same port and in the log."""
    with RunningServer() as server:
        status, health = server.get("/health")
        assert status == 200
        assert (health["status"], health["protocol"], health["clients"]) == ("ok", 1, 0)
        with server.client(name="me") as client:
            sensor = client.open()
            for _ in range(3):
                sensor.step(dome)
            _, health = server.get("/health")
            assert (health["clients"], health["sensors"], health["readings"]) == (1, 1, 3)
        wait_for(lambda: server.logged("disconnected"))
        assert server.get("/health")[1]["readings"] == 3
        assert server.get("/")[0] == 426
        assert server.get("/else")[0] == 404
    assert [e["event"] for e in server.events] == [
        "listening", "connected", "hello", "opened", "disconnected", "stopping", "stopped",
    ]  # fmt: skip
    assert server.logged("hello")[0]["name"] == "me"
    assert server.logged("disconnected")[0]["readings"] == 3


def test_stopping_closes_connections(dome: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame at hand is answered; clients are told that the server goes away, new ones too."""
    begun, go = hold_solves(monkeypatch)
    with RunningServer() as server, server.client() as client, server.client():
        sensor = client.open()
        sensor.send(dome)
        assert begun.wait(WAIT)
        stopping = threading.Thread(target=server.stop)
        stopping.start()
        wait_for(lambda: server.logged("stopping"))
        assert server.get("/health")[0] == 503
        with pytest.raises(ProtocolError, match="503"):
            server.client()
        go.set()
        assert client.reading(sensor.number, 0).sequence == 0
        stopping.join(WAIT)
        with pytest.raises(ProtocolError, match="1001"):
            sensor.step(dome)
        with pytest.raises(OSError, match="refused"):
            server.client()
    assert server.logged("stopped")[0]["readings"] == 1


@pytest.mark.parametrize(
    ("designs", "readout", "words"),
    [
        (("patch", "pach"), None, "pach"),
        (("patch", "six_patch", "patch"), None, "two designs are named 'patch'"),
        (("patch",), "fdc1005", "fdc1005"),
        (("patch",), "nowhere.toml", "nowhere"),
    ],
)
def test_wrong_designs_and_readouts(
    designs: tuple[str, ...], readout: str | None, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refused before the field of any design is built."""

    def build(*_: object, **__: object) -> None:
        raise AssertionError("built")

    monkeypatch.setattr("capsense.server.server.Simulator", build)
    with pytest.raises(CapSenseError, match=words):
        Server(ServerOptions(designs, readout))
    with pytest.raises(AssertionError, match="built"):
        Server(ServerOptions(("patch",), "fdc1004"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"designs": ()}, "no design"),
        ({"designs": ("patch",), "port": 70000}, "port is 70000"),
        ({"designs": ("patch",), "token": "short"}, "fewer than 8"),
        ({"designs": ("patch",), "host": "0.0.0.0"}, "lets other machines connect; give a token"),
        ({"designs": ("patch",), "host": "example.org"}, "lets other machines connect"),
    ],
)
def test_wrong_options(options: dict, words: str) -> None:
    """Refused before anything is built."""
    with pytest.raises(ServerError, match=words):
        ServerOptions(**options)
    for limit in ({"pixels": 0}, {"send_timeout": float("nan")}):
        with pytest.raises(ServerError, match="give a number above zero"):
            Limits(**limit)
    assert ServerOptions(("patch",), host="0.0.0.0", token=TOKEN).token == TOKEN
    assert ServerOptions(("patch",), host="::1").host == "::1"


def test_the_client_comes_back() -> None:
    """A server that goes and comes finds its client there again, the sensor opened as it was."""
    depth = np.full((8, 8), 0.05, np.float32)
    first = RunningServer().__enter__()
    with first.client() as client:
        sensor = client.open(sensor=3, material="steel")
        before = sensor.step(depth)
        first.stop()
        with pytest.raises(ProtocolError) as lost:
            sensor.step(depth)
        assert lost.value.code == "closed" or "closed the connection" in str(lost.value)
        with RunningServer(port=first.port):
            again = sensor.step(depth)
        assert (again.sensor, again.sequence) == (3, 2)
        np.testing.assert_allclose(again.delta, before.delta, rtol=1e-9)
        client.timeout = 0.5
        with pytest.raises(ProtocolError):
            sensor.step(depth)
        with pytest.raises(OSError):  # noqa: PT011, whatever the system says
            sensor.step(depth)
