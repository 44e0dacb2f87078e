"""Recordings as tables, arrays, and files made whole."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from importlib import resources
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._style import COLOURS
from capsense.errors import RecordingError, require_package
from capsense.readout.conversions import Counts, join
from capsense.recording import Session
from capsense.recording.reader import Recording, Step
from capsense.recording.tables import (
    Run,
    column_meanings,
    counts_columns,
    csv_row,
    replacing,
    touch_values,
    write_counts,
)
from capsense.scenario.model import read_channels

Array = NDArray[np.float64]

MAX_LINES = 8
"""So many channels are drawn in a chart, the strongest."""
_LAYOUT = resources.files("capsense.recording") / "layout.json"
"""What Foxglove is told of every recording: the scene, and how a chart looks."""


ENDINGS = (".csv", ".npz", ".parquet", ".mcap", ".json")
"""What a recording is exported to, by the ending of the file."""
_BATCH = 4096
"""Steps that go into a Parquet file at once."""


def export(recording: Recording, path: Path, *, counts: bool = False) -> int:
    """Write a recording as another file, which appears once it is complete.

    ``.csv`` and ``.parquet`` have the columns of ``readings.csv`` and the episode; ``.npz`` has the
    arrays of ``readings.npz``, the episode, and the counts; ``.mcap`` is the recording again, made
    whole if it was cut short; ``.json`` is a layout in which Foxglove shows it.

    Args:
        recording: What to export.
        path: The file; one that is there is replaced.
        counts: Write the readout's conversions in place of the readings; ``.csv``, ``.parquet``.

    Returns:
        Rows, samples, messages or layouts written.

    Raises:
        RecordingError: The ending is not known, the recording is damaged, or holds no steps or no
            counts.
        MissingDependencyError: Parquet needs pyarrow.
        OSError: The file could not be written.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise RecordingError(f"{path} must end in {', '.join(ENDINGS)}; that chooses the format")
    if counts and ending not in (".csv", ".parquet"):
        raise RecordingError("counts alone go to .csv or .parquet; .npz has them beside the rest")
    if ending == ".parquet":
        require_package("pyarrow.parquet", "pyarrow, which Parquet needs,", "record")
    writers: dict[str, Callable[[Recording, Path], int]] = {
        ".csv": _counts_csv if counts else _csv,
        ".parquet": _counts_parquet if counts else _parquet,
        ".npz": _npz,
        ".mcap": _mcap,
        ".json": _layout,
    }
    with replacing(path) as part:
        return writers[ending](recording, part)


def _values(recording: Recording) -> Iterator[tuple[Step, Array]]:
    """The steps, each with the capacitances of the session's channels [F], shape (K,)."""
    for step in recording.steps():
        yield step, read_channels(recording.session.channels, step.reading)


def _levels(session: Session) -> Array:
    """Capacitances of the channels with an empty scene [F], shape (K,)."""
    return read_channels(session.channels, session.empty)


def _csv(recording: Recording, path: Path) -> int:
    session, levels, n = recording.session, _levels(recording.session), 0
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        meanings = column_meanings(session.channels, session.design)
        rows.writerow([*(name for name, _ in meanings), "episode"])
        for step, values in _values(recording):
            row = csv_row(step.clock, values, levels, step.reading, session.design)
            rows.writerow([*row, step.episode])
            n += 1
    return n


def _parquet(recording: Recording, path: Path) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    session, levels = recording.session, _levels(recording.session)
    meanings = column_meanings(session.channels, session.design)
    fields = [pa.field(name, pa.float64(), metadata={"meaning": text}) for name, text in meanings]
    schema = pa.schema([*fields, pa.field("episode", pa.int64())])
    n, steps = 0, _values(recording)
    with pq.ParquetWriter(path, schema) as writer:
        while batch := list(islice(steps, _BATCH)):
            values = np.array([v for _, v in batch])
            touch = np.array([touch_values(s.reading, session.design) for s, _ in batch])
            columns = [[s.clock for s, _ in batch], *values.T, *(values - levels).T, *touch.T]
            columns += [[float(s.reading.in_contact) for s, _ in batch]]
            columns += [[s.episode for s, _ in batch]]
            arrays = [pa.array(c, f.type) for c, f in zip(columns, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            n += len(batch)
    return n


def run_of(recording: Recording, steps: list[Step]) -> Run:
    """Steps of a recording as a run, by the recording's clock."""
    s = recording.session
    return Run(
        s.title or s.name, s.design, s.channels, s.empty, (), [k.clock for k in steps],
        [k.reading for k in steps], [k.scene for k in steps],
    )  # fmt: skip


def _npz(recording: Recording, path: Path) -> int:
    steps = list(recording.steps())
    if not steps:
        raise RecordingError(f"{recording.path} holds no steps; there is nothing to export")
    arrays = run_of(recording, steps).arrays()
    arrays["episode"] = np.array([s.episode for s in steps])
    counts = [c for c in (s.reading.counts for s in steps) if c is not None]
    if counts:
        arrays.update({f"counts_{k}": v for k, v in counts_columns(join(counts)).items()})
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return len(steps)


def _all_counts(recording: Recording) -> Counts:
    parts = [s.reading.counts for s in recording.steps()]
    found = [c for c in parts if c is not None]
    if not found:
        raise RecordingError(f"{recording.path} holds no counts; record with a readout")
    return join(found)


def _counts_csv(recording: Recording, path: Path) -> int:
    counts = _all_counts(recording)
    write_counts(path, counts)
    return len(counts)


def _counts_parquet(recording: Recording, path: Path) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    counts = _all_counts(recording)
    pq.write_table(pa.table(counts_columns(counts)), path)
    return len(counts)


def _layout(recording: Recording, path: Path) -> int:
    """A layout that Foxglove imports: the scene on the left, charts below each other beside it."""
    session, levels = recording.session, _levels(recording.session)
    peaks = np.zeros(len(levels))
    for _, values in _values(recording):
        peaks = np.maximum(peaks, np.abs(values - levels))
    data = json.loads(_LAYOUT.read_text(encoding="utf-8").replace("NAME", session.name))
    panels: dict[str, Any] = {"3D!sensor": data["scene"]}
    for key, title, own in (("own", "electrodes", True), ("pairs", "pairs", False)):
        found = [k for k, c in enumerate(session.channels) if (c.row == c.column) == own]
        strongest = sorted(sorted(found, key=lambda k: -peaks[k])[:MAX_LINES])
        paths = [
            {"value": f'/{session.name}/signals.channels[:]{{name=="{c.column_name}"}}.change',
             "label": c.label, "color": colour, "enabled": True, "timestampMethod": "receiveTime"}
            for c, colour in zip([session.channels[k] for k in strongest], COLOURS, strict=False)
        ]  # fmt: skip
        if paths:
            head = {"foxglovePanelTitle": f"{title}, change [fF]", "paths": paths}
            panels[f"Plot!{key}"] = head | data["chart"]
    first, *others = [key for key in panels if key.startswith("Plot")]
    right = {"direction": "column", "first": first, "second": others[0]} if others else first
    content = {
        "configById": panels, "globalVariables": {}, "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": "3D!sensor", "second": right,
                   "splitPercentage": 55},
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 1


def _mcap(recording: Recording, path: Path) -> int:
    """Copy every record that is whole into a file with an index."""
    from mcap.records import Attachment, Channel, Message, Metadata, Schema
    from mcap.writer import Writer

    from capsense.recording.files import read_records

    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    n = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="capsense")
        for r in read_records(recording.path):
            match r:
                case Schema() if r.id not in schemas:
                    schemas[r.id] = writer.register_schema(r.name, r.encoding, r.data)
                case Channel() if r.id not in channels:
                    channels[r.id] = writer.register_channel(
                        r.topic, r.message_encoding, schemas[r.schema_id], r.metadata
                    )
                case Message():
                    channel = channels[r.channel_id]
                    writer.add_message(channel, r.log_time, r.data, r.publish_time, r.sequence)
                    n += 1
                case Attachment():
                    writer.add_attachment(r.create_time, r.log_time, r.name, r.media_type, r.data)
                case Metadata():
                    writer.add_metadata(r.name, r.metadata)
        writer.finish()
    return n
