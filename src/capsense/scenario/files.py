"""Scenario files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from capsense._validate import read_toml
from capsense.design import Design, load_design
from capsense.errors import DesignError, ScenarioError
from capsense.scenario.bodies import ScenarioTable, read_bodies
from capsense.scenario.model import (
    FORMER_METHODS,
    METHODS,
    Excitation,
    Scenario,
)

if TYPE_CHECKING:
    from capsense.simulator import Method


TOP_KEYS = (
    "name", "description", "design", "sample_rate", "duration", "excitation",
    "pairs", "method", "body",
)  # fmt: skip


def load_scenario(path: str | Path) -> Scenario:
    """Load a scenario file.

    Args:
        path: The ``.toml`` file. Designs and meshes it names are relative to its folder.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong; the message names the
            file, the item, the value and the fix.
        DesignError: Something is wrong in the design file it names.
    """
    file = Path(path)
    data = read_toml(file, "scenario", ScenarioError)
    return parse_scenario(data, source=file.name, folder=file.parent)


def parse_scenario(
    data: Mapping[str, Any], *, source: str = "scenario", folder: Path | None = None
) -> Scenario:
    """Build a checked scenario from the content of its file, given as nested dicts.

    Args:
        data: What ``tomllib`` makes of a scenario file.
        source: Name of the file, for messages.
        folder: Folder that designs and meshes are relative to; the current one by default.

    Raises:
        ScenarioError: Anything is wrong; the message names the item, the value and the fix.
        DesignError: Something is wrong in the design file it names.
    """
    where = folder if folder is not None else Path()
    top = ScenarioTable(data, source, "scenario")
    _refuse_former(top)
    top.only(TOP_KEYS)
    top.needs("name", "design", "sample_rate")
    name = top.string("name")
    design = read_design(top, where)
    sample_rate = top.number("sample_rate", 1e-3, 1e6, unit="Hz")
    excitation = Excitation(top.choice("excitation", list(Excitation), Excitation.MATRIX.value))
    pairs = _read_pairs(top, excitation, design)
    bodies = read_bodies(top, where)
    if not bodies and "duration" not in top:
        raise top.error("has no body and no duration; add a [[body]], or duration = seconds")
    ends = [b.trajectory.duration for b in bodies if b.trajectory is not None]
    duration = top.number("duration", 0.0, 1e7, max(ends, default=0.0), unit="s")
    try:
        return Scenario(
            name=name,
            design=design,
            bodies=bodies,
            sample_rate=sample_rate,
            duration=duration,
            excitation=excitation,
            pairs=pairs,
            method=_read_method(top),
            description=top.text("description"),
        )
    except ScenarioError as error:
        raise top.error(str(error)) from None


def _refuse_former(top: ScenarioTable) -> None:
    """Say what to write instead of what files of earlier versions may hold."""
    if "tolerance" in top:
        raise top.error("tolerance is gone: no method needs one any more; remove the line")
    if "method" in top and top.raw("method", "a method") == "perturbation":
        raise top.error('method = "perturbation" is gone; write "surface", or remove the line')


def _read_method(top: ScenarioTable) -> Method:
    """The simulator's method, by its name or the one that earlier versions gave it."""
    name = top.data.get("method")
    if isinstance(name, str) and name in FORMER_METHODS:
        return FORMER_METHODS[name]
    return cast("Method", top.choice("method", METHODS, METHODS[0]))


def read_design(top: ScenarioTable, folder: Path) -> Design:
    """The design that ``design`` names: packaged, or a file relative to ``folder``.

    Raises:
        ScenarioError: There is no such design.
        DesignError: Something is wrong in its file.
    """
    value = top.string("design")
    is_path = value.endswith(".toml") or bool(set("/\\") & set(value))
    path = folder / value
    if is_path and not path.is_file():
        raise top.error(
            f"design = {value!r}: there is no file {path}; paths are relative to the scenario file"
        )
    try:
        return load_design(path if is_path else value)
    except DesignError as error:
        if is_path:
            raise
        raise top.error(f"design = {value!r}: {error}") from None


def _read_pairs(
    top: ScenarioTable, excitation: Excitation, design: Design
) -> tuple[tuple[str, str], ...]:
    if "pairs" not in top:
        if excitation is Excitation.MUTUAL and len(design.electrodes) < 2:
            raise top.error(
                f'excitation = "mutual" needs two electrodes; design {design.name!r} has one; '
                'use excitation = "self"'
            )
        return ()
    if excitation is not Excitation.MUTUAL:
        raise top.error(f'pairs is for excitation = "mutual", not "{excitation}"; remove one')
    what = 'a list of pairs of electrode names, like [["E1", "E2"]]'
    out: list[tuple[str, str]] = []
    names, owner = design.electrode_names, f"design {design.name!r}"
    for number, pair in enumerate(top.pairs("pairs", what, names, owner)):
        one, two = pair
        if one == two:
            raise top.error(f"pairs[{number}] = {[*pair]} must name two different electrodes")
        if pair in out or (two, one) in out:
            raise top.error(f"pairs[{number}] = {[*pair]} is listed twice; remove one")
        out.append(pair)
    return tuple(out)
