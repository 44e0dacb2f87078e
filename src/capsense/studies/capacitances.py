"""What a study computes at each point: capacitances of a design, changes by bodies, counts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.design import TOP_KEYS as DESIGN_KEYS
from capsense.design import Design, load_design, parse_design
from capsense.design import __file__ as design_file
from capsense.errors import CapSenseError, DesignError, ReadoutError, ScenarioError
from capsense.field.background import Terminals, build_background, empty_capacitance
from capsense.field.boundary import Accuracy, build_cost, build_model, terminals
from capsense.field.cache import cache_key, default_settings, is_at_hand, load_or_build
from capsense.reading import Reading, StepStats
from capsense.readout import Readout
from capsense.readout.config import TOP_KEYS as READOUT_KEYS
from capsense.readout.config import file_content, parse_readout
from capsense.scenario import ScenarioTable, read_bodies
from capsense.scenario.files import TOP_KEYS as SCENARIO_KEYS
from capsense.scenario.model import Excitation, channels_of, read_channels
from capsense.scene import Scene
from capsense.simulator import Simulator
from capsense.studies.points import WRONG_POINT
from capsense.studies.template import Point, Template

Array = NDArray[np.float64]

KEYS = {"design": DESIGN_KEYS, "scenario": SCENARIO_KEYS, "readout": READOUT_KEYS}
"""Kinds of files, and the first parts of their dotted keys."""
_EMPTY_TIME, _EMPTY_MEMORY = 0.3e-6, 20.0
"""Of a Maxwell matrix alone: processor time [s] and memory [byte] for each panel squared."""


class Cost(NamedTuple):
    """What the points of a study will cost."""

    designs: int
    """How many there are."""
    panels: int
    """Size of their boundary-element systems."""
    time: float
    """Processor time of their fields or matrices [s]; 0 for a field that is at hand."""
    memory: float
    """Of a process [byte]."""


@dataclass(frozen=True)
class Capacitances:
    """Maxwell matrices and counts of a sensor for values of its parameters; an
    :class:`~capsense.studies.Evaluation`.

    The outputs are

    - ``C0_E1_E2``, the upper triangle of the matrix in the empty domain [F];
    - ``dC_E1_E2``, its change by the bodies of the scenario as they stand at time 0 [F];
    - ``code0_E1``, what a chip reports of each of its channels in the empty domain [codes];
    - ``dcode_E1``, the change of that by the bodies [codes].

    Only what a parameter changes is made anew: where the design has none, its field is built once.
    Without bodies no field is built, and boundary elements are solved alone.
    """

    design: Template
    electrodes: tuple[str, ...]
    """Names of the electrodes in matrix order."""
    scenario: Template | None = None
    """Where the bodies are from; its design and its motion are not used."""
    readout: Template | None = None
    """The chip, without its noise."""
    channels: tuple[str, ...] = ()
    """Names of the chip's channels."""
    chip: str = ""
    """The chip's name where no file describes it: one that adapts is set up for each design."""
    _last: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)
    """What was made last of the design, by what it was made of."""

    @classmethod
    def of(
        cls,
        design: Template,
        points: Sequence[Point],
        scenario: Template | None = None,
        readout: Template | str | None = None,
    ) -> Capacitances:
        """Check files, and take names of electrodes and channels from the first sound point.

        Args:
            design: The design's file.
            points: Values of the parameters. A parameter is a name that expressions of any of the
                files use, or else a dotted key, such as ``body.finger.pose.position.z``.
            scenario: The scenario's file, of which the bodies are used.
            readout: A readout's file, or the name of a chip.

        Raises:
            DesignError: The design is wrong, or a parameter is not used.
            ScenarioError: The scenario is wrong.
            ReadoutError: The readout is wrong.
            CapSenseError: Nothing can be made of any point.
        """
        chip = readout if isinstance(readout, str) else ""
        if isinstance(readout, str):
            content = file_content(readout, ())
            readout = Template(readout, content, Path(), ReadoutError)
        files = {"design": design, "scenario": scenario, "readout": readout}
        _check_tables(files)
        given = {kind: file for kind, file in files.items() if file is not None}
        for kind, keys in _keys(given, list(points[0])).items():
            given[kind] = replace(given[kind], keys=keys)
        out = cls(given["design"], (), given.get("scenario"), given.get("readout"), chip=chip)
        first: CapSenseError | None = None
        for point in points:
            try:
                names = out.made(point).electrode_names
                out = replace(out, electrodes=names)
                out._scene(point)
                chip_there = out._readout(point, None)
            except WRONG_POINT as error:
                first = first or error
            else:
                return replace(out, channels=chip_there.channel_names if chip_there else ())
        assert first is not None
        raise first

    @classmethod
    def load(
        cls,
        design: str | Path,
        points: Sequence[Point],
        scenario: str | Path | None = None,
        readout: str | Path | None = None,
    ) -> Capacitances:
        """As :meth:`of`, from the paths of files, or the names of a packaged design and a chip."""
        return cls.of(
            load_design_template(design),
            points,
            None if scenario is None else load_scenario_template(scenario),
            None if readout is None else load_readout_template(readout),
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": {}}

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of the results."""
        names = [c.column_name[1:] for c in channels_of(Excitation.MATRIX, self.electrodes)]
        kinds = ("0", "") if self.scenario is not None else ("0",)
        out = [("C0" if kind else "dC") + name for kind in kinds for name in names]
        out += [f"{'code0' if k else 'dcode'}_{name}" for k in kinds for name in self.channels]
        return tuple(out)

    def made(self, point: Point) -> Design:
        """The design for values of the parameters.

        Raises:
            DesignError: It cannot be made: electrodes touch, say.
        """
        return self._design(point)[0]

    def _design(self, point: Point) -> tuple[Design, str]:
        """The design, and the key of its field."""
        used = {name: point[name] for name in self.design.parameters if name in point}
        if self._last.get("used") != used:
            design = parse_design(
                self.design.filled(point), source=self.design.name, folder=self.design.folder
            )
            self._last.update(used=used, design=design)
            self._last["key"] = cache_key(design, default_settings(design))
        return self._last["design"], self._last["key"]

    def _scene(self, point: Point) -> Scene | None:
        """The bodies at time 0, where there is a scenario."""
        if self.scenario is None:
            return None
        top = ScenarioTable(self.scenario.filled(point), self.scenario.name, "scenario")
        bodies = read_bodies(top, self.scenario.folder)
        return Scene([body.at(0.0) for body in bodies])

    def _readout(self, point: Point, empty: Reading | None) -> Readout | None:
        """The chip, where there is one; one that adapts is set up for a reading, if it is given."""
        if self.readout is None:
            return None
        content = self.readout.filled(point)
        if self.chip and empty is not None:
            content = {**file_content(content["chip"], self.electrodes, empty), **content}
        content = {k: v for k, v in content.items() if k != "noise"} | {"random": False}
        out = parse_readout(content, self.electrodes, source=self.readout.name)
        if self.channels and out.channel_names != self.channels:
            raise ReadoutError(
                f"{self.readout.name}: channels are {', '.join(out.channel_names)} here and "
                f"{', '.join(self.channels)} at the first point; keep them the same"
            )
        return out

    def key(self, point: Point) -> str:
        """Digest of the design, the bodies and the chip."""
        parts: list[Any] = [self._design(point)[1]]
        if self.scenario is not None:
            self._scene(point)
            bodies = self.scenario.filled(point)["body"]
            files = [self.scenario.folder / b["file"] for b in bodies if "file" in b]
            parts += [bodies, *(hashlib.sha256(f.read_bytes()).hexdigest() for f in files)]
        if self.readout is not None:
            self._readout(point, None)
            parts.append(self.readout.filled(point))
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def group(self, point: Point) -> str:
        """The key of the field, where parameters change it."""
        return self._design(point)[1] if self._varied else ""

    @cached_property
    def _varied(self) -> bool:
        """Whether parameters change the design."""
        return bool(self.design.parameters)

    def __call__(self, point: Point) -> tuple[float, ...]:
        """Solve the empty domain and, if there are bodies, their scene.

        Raises:
            CapSenseError: One of :data:`WRONG_POINT`, or a field or a scene was not solved.
        """
        scene, reading = self._scene(point), None
        if scene is None:
            empty = self._empty(point)
        else:
            sim = self._simulator(point)
            sim.reset()
            empty, reading = sim.empty, sim.step(scene)
        channels = channels_of(Excitation.MATRIX, self.electrodes)
        at_rest = read_channels(channels, empty)
        out = at_rest.tolist()
        if reading is not None:
            out += (read_channels(channels, reading) - at_rest).tolist()
        readout = self._readout(point, empty)
        if readout is not None:
            out += codes_at(readout, empty, reading)
        return tuple(out)

    def _empty(self, point: Point) -> Reading:
        """The empty domain by boundary elements alone."""
        design, key = self._design(point)
        if self._last.get("of") != key:
            matrix = empty_capacitance(design, default_settings(design))
            self._last.update(of=key, empty=empty_reading(design, matrix))
        return self._last["empty"]

    def _simulator(self, point: Point) -> Simulator:
        """A simulator of the design. Its field is cached unless parameters change it."""
        design, key = self._design(point)
        if self._last.get("of") != key:
            settings = default_settings(design)
            build = build_background if self._varied else load_or_build
            sim = Simulator(design, settings=settings, background=build(design, settings))
            self._last.update(of=key, sim=sim)
        return self._last["sim"]

    def cost(self, points: Sequence[Point]) -> Cost:
        """What points will cost, by the first and the last design among them."""
        sound, panels = {}, []
        for point in points:
            try:
                sound[self._design(point)[1]] = point
            except DesignError:
                continue
        ends = list(sound.values())
        for point in {id(p): p for p in (ends[0], ends[-1])}.values():
            design = self.made(point)
            accuracy = Accuracy(default_settings(design).panel_scale)
            panels.append(build_model(design.in_units, accuracy).panels.size)
        size = round(sum(panels) / len(panels))
        time, memory = build_cost(size)
        if self.scenario is not None and not self._varied:  # one process builds, others wait
            time, memory = time * (not is_at_hand(next(iter(sound)))), 4e8
        elif self.scenario is None:
            time, memory = 0.1 + _EMPTY_TIME * size**2, 4e8 + _EMPTY_MEMORY * size**2
        return Cost(len(sound), size, time * len(sound), memory)


def _check_tables(files: Mapping[str, Template | None]) -> None:
    """Refuse unknown tables, a scenario without bodies, and noise that parameters change."""
    scenario, readout = files["scenario"], files["readout"]
    if scenario is not None:
        top = ScenarioTable(scenario.content, scenario.name, "scenario")
        top.only(SCENARIO_KEYS)
        if not top.tables("body"):
            raise top.error("has no body; add a [[body]], or leave the scenario out")
    if readout is not None and Template("", {"n": readout.content.get("noise")}, Path()).parameters:
        raise ReadoutError(
            f"{readout.name}: noise: a parameter changes it, but studies leave noise out; vary an "
            "offset in [calibration] instead"
        )


def _keys(files: Mapping[str, Template], names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The dotted keys among names of parameters, by the kind of file that they are of."""
    used = set().union(*(file.parameters for file in files.values()))
    out: dict[str, tuple[str, ...]] = {}
    for name in names:
        if name in used:
            continue
        first = name.partition(".")[0]
        kind = next((k for k, keys in KEYS.items() if first in keys), "")
        if kind in files and first != "noise":
            out[kind] = (*out.get(kind, ()), name)
        elif kind == "readout" and kind in files:
            raise ReadoutError(f"{name}: studies leave noise out; vary calibration.offset instead")
        elif kind:
            raise DesignError(f"{name} is a key of a {kind}, and there is none; give --{kind}")
        else:
            hint = suggest(name, sorted(used)) if used else "there are no expressions"
            raise DesignError(
                f'no expression uses {name!r}, and it is no key; {hint}; write "={name}" in place '
                "of the number that is to vary, or give its key, such as electrode.E1.size.x"
            )
    return out


def is_code(output: str) -> bool:
    """Whether an output is of codes, and not of farads."""
    return output.startswith(("code0_", "dcode_"))


def unit_of_output(name: str) -> tuple[float, str]:
    """What an output is multiplied by to be shown, and its unit then."""
    return (1.0, "codes") if is_code(name) else (1e15, "fF")


def load_design_template(design: str | Path) -> Template:
    """The file of a design, by the name of a packaged one or its path.

    Raises:
        DesignError: There is no such design, or it is not TOML.
    """
    if not str(design).endswith(".toml"):
        load_design(str(design))  # or the error that says which names there are
        design = Path(design_file).parent / "library" / f"{design}.toml"
    return Template.load(design, "design", DesignError)


def load_scenario_template(path: str | Path) -> Template:
    """The file of a scenario.

    Raises:
        ScenarioError: There is no such file, or it is not TOML.
    """
    return Template.load(path, "scenario", ScenarioError)


def load_readout_template(choice: str | Path) -> Template | str:
    """The file of a readout by its path, or the name of a chip as it is.

    Raises:
        ReadoutError: There is no such file, or it is not TOML; or it is a readout, of which no
            number can be varied.
    """
    if not isinstance(choice, str | Path):
        raise ReadoutError(
            f"readout is {choice!r}; a study varies the numbers of files: give a chip's name, or "
            "the path of a readout file"
        )
    if str(choice).endswith(".toml"):
        return Template.load(choice, "readout", ReadoutError)
    return str(choice)


def empty_reading(design: Design, capacitance: Array) -> Reading:
    """What a simulator reads of an empty scene, by the Maxwell matrix of all terminals [F]."""
    assert len(capacitance) == len(terminals(design))
    matrix = Terminals(design, capacitance).empty
    n = len(design.electrodes)
    return Reading(
        matrix[:n, :n].copy(), np.zeros((n, n)), StepStats(0.0, 0.0), design.electrode_names,
        matrix[:n, n:].sum(axis=1),
    )  # fmt: skip


def codes_at(readout: Readout, empty: Reading, reading: Reading | None = None) -> list[float]:
    """What a chip reports at rest, and how that changes when it has seen bodies.

    It sees the empty domain for two rounds of its channels, then the bodies for two.

    Args:
        readout: The chip.
        empty: The empty domain.
        reading: The bodies, if there are any.

    Returns:
        Codes of each channel in the empty domain, then their changes where there are bodies.
    """
    plan = readout.schedule
    phase = 2.0 * plan.period
    times, readings = [0.0, phase + plan.lag], [empty, empty]
    if reading is not None:
        times = [0.0, phase, 1.5 * phase, 2.5 * phase + plan.lag]
        readings = [empty, empty, reading, reading]
    counts = readout(times, readings)
    codes = [counts.of(name).code for name in readout.channel_names]
    rest = [float(code[0]) for code in codes]
    return rest if reading is None else [*rest, *(float(c[-1] - c[0]) for c in codes)]
