"""Readouts from TOML files that lie beside a design."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, cast

from capsense import _validate
from capsense._validate import read_toml, suggest
from capsense.errors import ReadoutError
from capsense.readout.calibration import LinearSensor, ResponseCurve
from capsense.readout.channels import (
    RESTS,
    Pattern,
    Rest,
    Wiring,
    differential_patterns,
    mutual_patterns,
    self_patterns,
    two_terminal_patterns,
)
from capsense.readout.converter import Detector, ExponentialTracker, SteppingTracker, Tracker
from capsense.readout.laws import Law, ResonanceLaw, ShuntLaw
from capsense.readout.presets import CHIPS, Chip, ReadoutOptions, chip_of, expected_of
from capsense.readout.readout import ReadingLike, Readout, build

TOP_KEYS = (
    "chip", "rate", "period", "latency", "seed", "random", "expected", "capdac", "mode", "pairs",
    "rest", "channel", "tank", "front_end", "wiring", "noise", "climate", "detector", "calibration",
    "curve", "nonlinearity", "capdac_errors", "specimen",
)  # fmt: skip


Limits = Mapping[str, tuple[float, float, str]]
"""Key → least and largest number, and their unit."""


class ReadoutTable(_validate.Table):
    """One table of a readout file; whatever is wrong raises :class:`ReadoutError`."""

    error_type = ReadoutError

    @contextmanager
    def named(self) -> Iterator[None]:
        """Errors that are raised inside name the file and the item."""
        try:
            yield
        except ReadoutError as error:
            raise self.error(str(error)) from None


def load_readout(path: str | Path, electrodes: Sequence[str], **options: Any) -> Readout:
    """Load a readout file.

    Args:
        path: The ``.toml`` file.
        electrodes: Electrode names of the sensor, in matrix order.
        **options: Those of :class:`~capsense.readout.presets.ReadoutOptions` that go before what
            the file says; ``stages`` come before those of the file.

    Raises:
        ReadoutError: There is no such file, or anything in it is wrong; the message names the
            file, the item, the value and the fix.
    """
    file = Path(path)
    content = read_toml(file, "readout", ReadoutError)
    return parse_readout(content, electrodes, source=file.name, **options)


def choose_readout(choice: str | Path, electrodes: Sequence[str], empty: ReadingLike) -> Readout:
    """A readout by the name of a chip, or from a file.

    Args:
        choice: A chip's name, or the path of a readout file, ``.toml``.
        electrodes: Electrode names of the sensor, in matrix order.
        empty: The sensor's reading of an empty scene. A named chip that adapts to its electrodes
            is set up for it; a file says ``expected`` itself.

    Raises:
        ReadoutError: There is no such chip or file, or the file is wrong.
    """
    content = file_content(choice, electrodes, empty)
    return parse_readout(content, electrodes, source=Path(choice).name)


class _Sensor(Protocol):
    """A simulator, as far as a chip has to know it."""

    @property
    def electrode_names(self) -> tuple[str, ...]: ...

    @property
    def empty(self) -> ReadingLike: ...


def make_readout(readout: Readout | str | Path, sensor: _Sensor) -> Readout:
    """The readout given, or that of a chip or a file for a sensor's electrodes.

    Raises:
        ReadoutError: There is no such chip or file, or the file is wrong.
    """
    if isinstance(readout, Readout):
        return readout
    if not isinstance(readout, str | Path):
        raise ReadoutError(f"readout is {readout!r}; give a chip's name, a file, or a Readout")
    return choose_readout(readout, sensor.electrode_names, sensor.empty)


def file_content(
    choice: str | Path, electrodes: Sequence[str], empty: ReadingLike | None = None
) -> dict[str, Any]:
    """What a readout file holds, or would hold to say the same as the name of a chip.

    Args:
        choice: A chip's name, or the path of a readout file, ``.toml``.
        electrodes: Electrode names of the sensor, in matrix order.
        empty: The sensor's reading of an empty scene, which a named chip is set up for.

    Raises:
        ReadoutError: There is no such chip or file, or it is not TOML.
    """
    if str(choice).endswith(".toml"):
        return read_toml(Path(choice), "readout", ReadoutError)
    chip = chip_of(str(choice))
    if empty is None:
        return {"chip": chip.name}
    values = build(chip, electrodes).channel_values(empty)
    return {"chip": chip.name, "expected": expected_of(values)}


def parse_readout(
    data: Mapping[str, Any], electrodes: Sequence[str], *, source: str = "readout", **changes: Any
) -> Readout:
    """Build a readout from the content of its file, given as nested dicts.

    ``changes`` are options of :func:`load_readout`.

    Raises:
        ReadoutError: Anything is wrong.
    """
    top = ReadoutTable(data, source, "readout")
    top.only(TOP_KEYS)
    chip = chip_of(top.choice("chip", tuple(CHIPS)))
    options: dict[str, Any] = {"patterns": _patterns(top, chip.mode, electrodes)}
    limits = {
        "rate": (1e-3, 1e7, "Hz"), "period": (1e-6, 1e6, "s"), "latency": (0.0, 1e3, "s"),
        "expected": (1e-15, 1e-6, "F"), "nonlinearity": (-0.1, 0.1, ""),
    }  # fmt: skip
    options.update(_given(top, limits))
    if "capdac" in top:
        options["capdac"] = top.integer("capdac", 0, 10**6)
    if "capdac_errors" in top:
        options["capdac_errors"] = _numbers(top, "capdac_errors")
    if "specimen" in top:
        options["specimen"] = top.integer("specimen", 0, 2**63 - 1)
    options["seed"] = top.integer("seed", 0, 2**63 - 1, 0)
    options["noise"] = top.boolean("random", True)
    if "tank" in top or "front_end" in top:
        options["law"] = _law(top, chip)
    for key, read in (
        ("wiring", _wiring), ("noise", _noise), ("climate", _climate), ("detector", _detector),
    ):  # fmt: skip
        if key in top:
            table = ReadoutTable(top.data[key], source, key)
            options.update(read(table))
    options["stages"] = tuple(
        read_stage(ReadoutTable(top.data[key], source, key))
        for key, read_stage in (("curve", _curve), ("calibration", _calibration))
        if key in top
    )
    options |= {**changes, "stages": (*changes.get("stages", ()), *options["stages"])}
    with top.named():
        return build(chip, electrodes, ReadoutOptions.of(options))


def _given(table: ReadoutTable, limits: Limits) -> dict[str, float]:
    """Numbers of the keys that a table holds, within their limits."""
    return {
        key: table.number(key, low, high, unit=unit)
        for key, (low, high, unit) in limits.items()
        if key in table
    }


def _law(top: ReadoutTable, chip: Chip) -> Law:
    """A tank or front end of one's own; what the file leaves out is as the chip has it."""
    law = chip.law
    for key, kind in (("tank", ResonanceLaw), ("front_end", ShuntLaw)):
        if key in top and not isinstance(law, kind):
            fitting = ", ".join(c.name for c in CHIPS.values() if isinstance(c.law, kind))
            raise top.error(f"the {chip.name} has no {key}; it goes with chip = {fitting}")
    if isinstance(law, ResonanceLaw):
        table = ReadoutTable(top.data["tank"], top.source, "tank")
        table.only(("inductance", "capacitance", "reference"))
        return replace(
            law,
            inductance=table.number("inductance", 1e-9, 1.0, law.inductance, "H"),
            fixed=table.number("capacitance", 1e-15, 1e-3, law.fixed, "F"),
            reference=table.number("reference", 1e5, 1e9, law.reference, "Hz"),
        )
    assert isinstance(law, ShuntLaw)
    table = ReadoutTable(top.data["front_end"], top.source, "front_end")
    limits = {
        "frequency": (1.0, 1e10, "Hz"), "shunt": (1e-3, 1e12, "Ω"), "gain": (1e-6, 1e9, ""),
        "amplitude": (1e-6, 1e6, "V"), "bandwidth": (1.0, 1e12, "Hz"),
        "parasitic": (0.0, 1e-6, "F"),
    }  # fmt: skip
    table.only((*limits, "full_scale", "bits"))
    full_scale = table.number("full_scale", 1e-9, 1e6, law.full_scale, "V")
    bits = table.integer("bits", 2, 32, law.bits)
    given = _given(table, limits)
    if "frequency" in given:
        given["excitation_frequency"] = given.pop("frequency")
    with table.named():
        return ShuntLaw(replace(law.front_end, **given), full_scale, bits)


def _patterns(top: ReadoutTable, mode: str, electrodes: Sequence[str]) -> tuple[Pattern, ...]:
    """Channels from [[channel]], or from ``mode``, ``pairs`` and ``rest``."""
    if "channel" in top:
        for key in ("mode", "pairs", "rest"):
            if key in top:
                raise top.error(f"{key} and [[channel]] both choose the channels; keep one")
        return tuple(
            _pattern(ReadoutTable(raw, top.source, f"channel {number}"), electrodes)
            for number, raw in enumerate(top.tables("channel"), start=1)
        )
    mode = top.choice("mode", ("self", *_OF_PAIRS), mode)
    rest = cast("Rest", top.choice("rest", RESTS, "grounded"))
    if mode == "self":
        if "pairs" in top:
            raise top.error(f"pairs is for mode = {', '.join(map(repr, _OF_PAIRS))}; remove one")
        return self_patterns(electrodes, rest=rest)
    what = 'a list of pairs of electrode names, like [["E1", "E2"]]'
    pairs = top.pairs("pairs", what, electrodes, "the sensor")
    with top.named():
        return _OF_PAIRS[mode](electrodes, pairs, rest=rest)


_OF_PAIRS = {
    "mutual": mutual_patterns, "differential": differential_patterns,
    "two-terminal": two_terminal_patterns,
}  # fmt: skip
"""Modes that measure pairs of electrodes → what makes their patterns."""


def _pattern(table: ReadoutTable, electrodes: Sequence[str]) -> Pattern:
    table.only(("name", "sense", "drive", "floating", "rest", "shield", "low", "minus"))
    table.needs("name", "sense")
    sense: Any = table.raw("sense", 'an electrode, "E1", several, ["E1", "E2"], or their weights')
    if isinstance(sense, dict):
        sense = _weights(table, "sense", electrodes)
    elif isinstance(sense, list):
        sense = _names(table, "sense", electrodes)
    else:
        sense = table.string("sense")
        _require_electrode(table, "sense", sense, electrodes)
    drive, low = _weights(table, "drive", electrodes), _names(table, "low", electrodes)
    rest = cast("Rest", table.choice("rest", RESTS, "grounded"))
    shield = table.number("shield", -1e3, 1e3, 0.0 if drive or low else 1.0)
    minus: Any = table.data.get("minus")
    if isinstance(minus, dict):
        sub = ReadoutTable(minus, table.source, f"{table.item}: minus")
        minus = _pattern(sub, electrodes)
    elif minus is not None:
        minus = table.string("minus")
        _require_electrode(table, "minus", minus, electrodes)
    floating, name = _names(table, "floating", electrodes), table.text("name")
    with table.named():
        return Pattern(sense, drive, floating, rest, shield, name, low, minus)


def _numbers(table: ReadoutTable, key: str) -> list[float]:
    """A list of capacitances [F]."""
    given = table.series(key, -1e-9, 1e-9, "F")
    if not isinstance(given, list):
        raise table.error(f"{key} = {given!r} must be a list, one number a bit")
    return given


def _weights(table: ReadoutTable, key: str, electrodes: Sequence[str]) -> dict[str, float]:
    """Numbers by the names of electrodes; none where there is no such key."""
    sub = ReadoutTable(table.data.get(key, {}), table.source, f"{table.item}: {key}")
    for name in sub.data:
        _require_electrode(table, key, name, electrodes)
    return {name: sub.number(name, -1e3, 1e3) for name in sub.data}


def _names(table: ReadoutTable, key: str, electrodes: Sequence[str]) -> tuple[str, ...]:
    """Names of electrodes; none where there is no such key."""
    names = table.data.get(key, [])
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise table.error(f"{key} = {names!r} must be a list of electrode names")
    for name in names:
        _require_electrode(table, key, name, electrodes)
    return tuple(names)


def _require_electrode(table: ReadoutTable, key: str, name: str, electrodes: Sequence[str]) -> None:
    if name not in electrodes:
        raise table.error(f"{key} names no electrode {name!r}; {suggest(name, electrodes)}")


def _wiring(table: ReadoutTable) -> dict[str, Any]:
    table.only(("trace", "cable", "shield_gain", "crosstalk", "coupling"))
    capacitances = {
        key: table.series(key, 0.0, 1e-6, "F")
        for key in ("trace", "cable", "coupling")
        if key in table
    }
    return {
        "wiring": Wiring(
            shield_gain=table.number("shield_gain", 0.0, 1.0, 0.0),
            crosstalk=table.number("crosstalk", -1.0, 1.0, 0.0),
            **capacitances,
        )
    }


def _noise(table: ReadoutTable) -> dict[str, Any]:
    limits = {
        "white": (0.0, 1e-9, "F"), "flicker": (0.0, 1e-9, "F"), "walk": (0.0, 1e-9, "F/√s"),
        "mains": (0.0, 1e-9, "F"), "mains_frequency": (1.0, 1e3, "Hz"),
    }  # fmt: skip
    table.only(limits)
    return _given(table, limits)


def _climate(table: ReadoutTable) -> dict[str, Any]:
    coefficients = {
        "offset_per_kelvin": (-1e-9, 1e-9, "F/K"), "gain_per_kelvin": (-1.0, 1.0, "1/K"),
        "offset_per_percent": (-1e-9, 1e-9, "F"), "gain_per_percent": (-1.0, 1.0, ""),
    }  # fmt: skip
    table.only(("temperature", "humidity", *coefficients))
    out: dict[str, Any] = _given(table, coefficients)
    for key in ("temperature", "humidity"):
        value = table.data.get(key)
        if isinstance(value, list):
            out[key] = table.vectors(key, 2, "[time in s, value]")
        elif value is not None:
            out[key] = table.number(key, -273.15, 1000.0)
    return out


def _detector(table: ReadoutTable) -> dict[str, Any]:
    table.only(("touch", "release", "debounce", "tracker", "samples"))
    kind = table.choice("tracker", ("exponential", "stepping"), "exponential")
    tracker: Tracker = SteppingTracker()
    if kind == "exponential":
        tracker = ExponentialTracker(table.number("samples", 1e-3, 1e9, 1000.0))
    elif "samples" in table:
        raise table.error('samples is for tracker = "exponential"; remove one')
    touch = table.number("touch", 1e-9, 1e12, unit="codes")
    release = table.number("release", 1e-9, touch, 0.5 * touch, unit="codes")
    return {"detector": Detector(touch, release, tracker, table.integer("debounce", 1, 10**6, 1))}


def _calibration(table: ReadoutTable) -> LinearSensor:
    """What ``Calibration.toml`` writes: one number for all channels, or one per channel."""
    limits = {"gain": (-1e6, 1e6, ""), "offset": (-1e-6, 1e-6, "F"), "drift": (-1e-6, 1e-6, "F/s")}
    table.only((*limits, "epoch"))
    given = {key: table.series(key, *limit) for key, limit in limits.items() if key in table}
    figures: dict[str, Any] = {"gain": 1.0, "offset": 0.0, "drift": 0.0, **given}
    epoch = table.number("epoch", -1e12, 1e12, 0.0)
    with table.named():
        return LinearSensor(**figures, epoch=epoch)


def _curve(table: ReadoutTable) -> ResponseCurve:
    """What ``ResponseCurve.toml`` writes: points for all channels, or a list of them for each."""
    table.only(("true", "measured"))
    what = "a list of capacitances in F, or one list per channel"
    points = {key: table.raw(key, what) for key in ("true", "measured")}
    with table.named():
        return ResponseCurve(**points)
