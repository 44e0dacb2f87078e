"""Publishing over DDS, received by a process that has the types by hand."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import recorded_scenes

import capsense as cs
from capsense.errors import MissingDependencyError

DOMAIN = 77
LOCAL = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface name="lo"/></Interfaces></General>
<Discovery><Peers><Peer address="127.0.0.1"/></Peers>
<ParticipantIndex>auto</ParticipantIndex></Discovery></Domain></CycloneDDS>"""
LISTENER = """
import time
from dataclasses import dataclass
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32

@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32

@dataclass
class Matrix(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    layout: Layout
    data: sequence[float64]

@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32

@dataclass
class Clock(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    clock: Time

participant = DomainParticipant({domain})
matrices = DataReader(participant, Topic(participant, "rt/sensor/delta", Matrix))
clocks = DataReader(participant, Topic(participant, "rt/clock", Clock))
found = [None, None]
until = time.monotonic() + 60
while None in found and time.monotonic() < until:
    for k, reader in enumerate((matrices, clocks)):
        for sample in reader.take(N=10):
            found[k] = sample
    time.sleep(0.01)
matrix, clock = found
print(repr(([d.label for d in matrix.layout.dim], list(matrix.data), clock.clock.sec)))
"""


def test_a_listener_reads_it(
    sim: cs.Simulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same numbers in another process; the file is recorded all the same."""
    pytest.importorskip("cyclonedds", reason="needs pip install 'capsense[live]'")
    monkeypatch.setenv("CYCLONEDDS_URI", LOCAL)
    path = tmp_path / "a.mcap"
    listener = subprocess.Popen(
        [sys.executable, "-c", LISTENER.format(domain=DOMAIN)], stdout=subprocess.PIPE, text=True
    )
    with cs.record(path, sim, ros_domain=DOMAIN) as run:
        for k in range(20_000):
            world = recorded_scenes.frame_at(0) if k % 2 else recorded_scenes.scene_at(0)
            run.step(world, 5.0 + 1e-5 * k)
            if listener.poll() is not None:
                break
    out, _ = listener.communicate(timeout=60)
    assert listener.returncode == 0
    labels, data, sec = ast.literal_eval(out)
    assert (labels, sec) == (["row", "column"], 5)
    steps = list(cs.open_recording(path).steps())
    assert data in [s.reading.delta.ravel().tolist() for s in steps]
    assert len(steps) == k + 1


def test_missing_package(
    sim: cs.Simulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    with pytest.raises(MissingDependencyError, match=r"capsense\[live\]"):
        cs.record(tmp_path / "a.mcap", sim, ros_domain=0)
    assert not (tmp_path / "a.mcap").exists()
