"""Random chips of data sets: settings drawn from a file, and figures that scatter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from capsense.errors import ReadoutError
from capsense.learning.draws import Draw, alternatives, columns_of
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.readout.config import choose_readout, file_content, load_readout, parse_readout
from capsense.readout.conversions import Held
from capsense.readout.presets import chip_of, expected_of
from capsense.readout.randomisation import FIGURES, Distribution, ReadoutRandomisation
from capsense.readout.side_by_side import SideBySide
from capsense.scenario import ScenarioTable

PATH = "readout"
"""Begins the names of columns of what is drawn of the readout's settings."""
_SEEDS = 2**63
_KINDS = {"uniform": ("from", "to"), "normal": ("mean", "sigma")}
"""Distributions of figures, and the keys of their tables."""


def settling(readout: Readout) -> float:
    """Time after which every channel has reported what it sees now [s]."""
    return 2 * readout.schedule.period + readout.schedule.lag


def settled(readout: Readout, reading: Reading, start: float) -> Held:
    """The registers after a reading has stood from ``start`` [s] for the time of settling."""
    readout.sample(start, reading)
    return readout.sample(start + settling(readout), reading).held()


@dataclass(frozen=True, eq=False)
class DrawnChip:
    """The chip of one scene."""

    name: str
    """Of the chip."""
    readout: Readout
    """With its seed."""
    drawn: Mapping[str, Any]
    """What was drawn of its settings, by column."""
    scatter: ReadoutRandomisation | None
    """How its figures are drawn; None where they are not."""

    def registers(self, empty: Reading, reading: Reading) -> tuple[Held, Held, dict[str, Any]]:
        """What the chip holds after the empty scene, and then another, has stood still.

        Returns:
            Both, each channel of shape (K,), and the chip's columns.
        """
        chip = self.readout
        columns: dict[str, Any] = {**self.drawn, "chip": self.name, "chip_seed": chip.seed}
        if chip.dac is not None:
            columns["dac_errors"] = chip.dac.specimens(len(chip.bank), chip.seed)  # (K, bits)
        if self.scatter is None:
            one = settled(chip, empty, 0.0)
            return one, settled(chip, reading, settling(chip)), columns
        many = SideBySide(chip, 1, seed=chip.seed, randomisation=self.scatter)
        wait = settling(chip) + self.scatter.most("delay") + self.scatter.most("jitter")
        held = []
        for number, seen in enumerate((empty, reading)):
            shields = (seen.self_capacitance - np.diag(seen.capacitance))[None, None]
            for time in (number * wait, (number + 1) * wait):
                now = many.sample(time, seen.capacitance[None, None], shields)
            held.append(Held(*(a[0, 0] for a in (now.capacitance, now.code, now.age))))
        figures = {f"chip_{n}": getattr(many.drawn, n)[0, 0] for n in FIGURES}
        for name in ("dead", "stuck"):
            figures[f"chip_{name}"] = figures[f"chip_{name}"].astype(bool)
        return held[0], held[1], columns | figures


class ChipSource:
    """The chips of a data set as its file describes them.

    Args:
        choice: The name of a chip, a readout file, or a table as a readout file holds it, whose
            values may be random.
        scatter: The table ``[randomisation]``; None for none.
        folder: Files are named relative to this folder.
        source: Name of the data set's file, for messages.
        electrodes: Electrode names of the sensor, in matrix order.

    Raises:
        ScenarioError: What should be random is written wrongly.
        ReadoutError: There is no such chip or file, or anything about it is wrong; or the chips
            that may be drawn have different channels.
    """

    def __init__(
        self, choice: str | Mapping[str, Any], scatter: Mapping[str, Any] | None, folder: Path,
        source: str, electrodes: tuple[str, ...],
    ) -> None:  # fmt: skip
        self._choice, self._folder, self._electrodes = choice, folder, electrodes
        self._table = ScenarioTable(
            choice if isinstance(choice, Mapping) else {}, source, "readout"
        )
        self._fixed: Readout | None = None
        self._scatter = None if scatter is None else _scatter(
            ScenarioTable(scatter, source, "randomisation")
        )  # fmt: skip
        named = self._examples()
        options = list(named.values())
        self.channel_names = options[0].channel_names
        """Names of the channels."""
        self.dac_bits = max(0 if o.dac is None else o.dac.bits for o in options)
        """Most bits that an offset DAC has; 0 where no chip has one."""
        for name, other in named.items():
            if other.channel_names != self.channel_names:
                raise ReadoutError(
                    f"{source}: the {name} has channels {', '.join(other.channel_names)}, but the "
                    f"{next(iter(named))} {', '.join(self.channel_names)}; give chips of one data "
                    "set the same ones: mode, pairs or [[readout.channel]]"
                )
        if self._scatter is not None:
            for one in options:
                SideBySide(one, 1, randomisation=self._scatter)

    @property
    def scatters(self) -> bool:
        """Whether figures scatter."""
        return self._scatter is not None

    @property
    def columns(self) -> dict[str, type]:
        """Columns of what is drawn of the settings, and what is in them."""
        return dict(columns_of(self._table.data, self._table, PATH))

    def draw(self, rng: Generator, empty: Reading) -> DrawnChip:
        """The chip of a scene.

        Args:
            rng: Random numbers.
            empty: The reading of the empty scene, which chips that adapt are set up for.

        Raises:
            ReadoutError: What was drawn makes no readout.
        """
        drawn: dict[str, Any] = {}
        if isinstance(self._choice, str):
            if self._fixed is None:
                self._fixed = choose_readout(self._place, self._electrodes, empty)
            name, readout = self._place, self._fixed
            if str(name).endswith(".toml"):
                name = file_content(name, self._electrodes)["chip"]
        else:
            name, readout, drawn = self._built(self._choice, rng, empty)
        readout.reset(seed=int(rng.integers(_SEEDS)))
        return DrawnChip(chip_of(str(name)).name, readout, drawn, self._scatter)

    @property
    def _place(self) -> str | Path:
        """The name of a chip, or the path of a readout file."""
        choice = str(self._choice)
        return self._folder / choice if choice.endswith(".toml") else choice

    def _built(
        self, table: Mapping[str, Any], rng: Generator, empty: Reading | None
    ) -> tuple[str, Readout, dict[str, Any]]:
        draw = Draw(rng)
        content = draw.table(table, self._table, PATH)
        source = f"{self._table.source}: readout"
        readout = parse_readout(content, self._electrodes, source=source)
        if empty is not None and "expected" not in content:
            content["expected"] = expected_of(readout.channel_values(empty))
            readout = parse_readout(content, self._electrodes, source=source)
        return content["chip"], readout, draw.drawn

    def _examples(self) -> dict[str, Readout]:
        """One readout of every chip that there may be, by its name."""
        choice, place = self._choice, self._place
        if isinstance(choice, str):
            if isinstance(place, Path):
                return {place.name: load_readout(place, self._electrodes)}
            return {place: Readout.preset(place, self._electrodes)}
        if "seed" in choice:
            raise self._table.error("seed is drawn for every scene; remove it")
        chips = alternatives(choice.get("chip"))
        rng = np.random.default_rng(0)
        built = (self._built({**choice, "chip": c}, rng, None) for c in chips)
        return {name: readout for name, readout, _ in built}


def _scatter(table: ScenarioTable) -> ReadoutRandomisation:
    """The figures of ``[randomisation]``."""
    table.only(FIGURES)
    figures = {}
    for name, value in table.data.items():
        figures[name] = value
        if isinstance(value, Mapping):
            kind = next((k for k, keys in _KINDS.items() if set(value) == set(keys)), None)
            if kind is None:
                forms = " or ".join(f"{{ {a} = …, {b} = … }}" for a, b in _KINDS.values())
                raise table.error(f"{name} = {dict(value)} must be a number, a list, or {forms}")
            sub = ScenarioTable(value, table.source, f"{table.item}: {name}")
            first, second = (sub.number(key, -1e12, 1e12) for key in _KINDS[kind])
            figures[name] = Distribution(kind, first, second)  # type: ignore[arg-type]
    try:
        return ReadoutRandomisation(**figures)
    except ReadoutError as error:
        raise table.error(str(error)) from None


def padded(array: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    """Errors of offset DACs with NaN for bits that a chip does not have, row by row."""
    out = np.full((len(array), bits), np.nan)
    out[:, : array.shape[1]] = array
    return out.ravel()
