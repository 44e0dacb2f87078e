"""Set measurements of the laboratory experiment against the simulator: docs/experiment.md.

    python examples/experiment/compare.py measured.csv -o out/

Every position of the file is simulated. What a laboratory cannot know is fitted: a gain and a
level without a body for each channel, the zero of the stage for each body, and its tilt if asked
for. What remains is set against limits that were fixed before anybody measured,
:data:`STATEMENTS`.
"""

from __future__ import annotations

import argparse
import csv
import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.design import Design, parse_design
from capsense.errors import CapSenseError, ReadoutError
from capsense.readout.channels import ChannelBank, Pattern

Array = NDArray[np.float64]
HERE = Path(__file__).parent

PATTERNS = (
    *(Pattern(name, shield=1.0) for name in ("L", "M", "S", "T")),
    Pattern("R", {"T": 1.0}, shield=0.0, name="TR"),
)
"""What is measured: four pads against ground, the guard driven along, and the pair."""
CHANNELS = tuple(p.name for p in PATTERNS)
KEYS = ("body", "x_mm", "y_mm", "height_mm", "grounding", "cover_mm", "direction")
COLUMNS = (*KEYS, *(f"{name}_pF" for name in CHANNELS))
DIRECTIONS = ("down", "up", "none")
GROUNDINGS: dict[str, Any] = {"grounded": "grounded", "floating": "floating", "100pF": 100e-12}
BODIES: dict[str, tuple[Any, float, tuple[float, float, float]]] = {
    "plate": (cs.Box((0.1, 0.1, 0.005)), 0.0025, (0.0, 0.0, 0.0)),
    "disc": (cs.Cylinder(0.015, 0.005), 0.0025, (0.0, 0.0, 0.0)),
    "tube": (cs.Cylinder(0.030, 0.200), 0.030, (0.0, math.pi / 2, 0.0)),
}
"""Shape, height of its origin above its lowest point [m], and angles [rad]. ``height_mm`` is that
of the lowest point above the front copper."""
TILTED = "plate"
"""The body whose tilt can be told: what is centred over a pad changes with its square alone."""
NO_BODY = ("empty", "open")
"""Rows of the board alone, and of the cables without the board."""
FR4 = 4.5
"""Relative permittivity that the design assumes."""
STEP = 1.1
"""Factor on the permittivity for its effect on the baseline."""
MODEL = 0.01
"""A sample weighs by its noise, and by this part of the change: the simulator's own error."""
STAGE = 3e-6
"""Standard uncertainty of a height beyond the zero [m]: the stage's linearity."""
CHIP_GAIN = 0.01
"""Standard uncertainty of the meter's gain."""
RANGES = ((0.0, 5e-3), (5e-3, 50e-3), (50e-3, 1.0))
"""Of heights [m]: the upper end belongs to the range."""
CLEAR = 0.03
"""Errors count where noise and heights explain less than this part of the change."""


class Statement(NamedTuple):
    """A statement of the documentation that the experiment decides on."""

    key: str
    text: str
    limit: float


STATEMENTS = (
    Statement("near", "grounded, up to 5 mm, L M T: rms error", 0.03),
    Statement("near small", "grounded, up to 5 mm, 3 mm pad S: rms error", 0.07),
    Statement("far", "grounded, 5 to 150 mm, all pads: rms error", 0.02),
    Statement("mutual", "grounded, all heights, pair TR: rms error", 0.05),
    Statement("floating", "floating over grounded, to 50 mm, L M T: rms error of the ratio", 0.03),
    Statement("tied", "100 pF over grounded, to 50 mm, L M T: rms error of the ratio", 0.03),
    Statement("cover", "acrylic of 2 mm, all heights, L M T: rms error", 0.03),
    Statement("scale", "absolute scale: gain of L less 1", 0.02),
    Statement("permittivity", "FR-4 of 4.5: its error, from the empty board", 0.05),
    Statement("noise", "noise over that of the FDC1004's preset: |log2|", 1.0),
)
"""Limits, fixed before measuring; the first ones are what docs/accuracy.md promises, rounded up."""


@dataclass(frozen=True)
class Position:
    """A row of the file, without its values."""

    body: str
    x: float
    y: float
    height: float
    """Of the body's lowest point above the front copper, as the stage reads it [m]."""
    grounding: str
    cover: float
    """Thickness of the acrylic sheet on the board [m], 0 without one."""
    direction: str


@dataclass(frozen=True, eq=False)
class LabFit:
    """What the fit found."""

    positions: list[Position]
    measured: Array
    """Changes against the level without a body, over the gain [F], shape (n, K)."""
    simulated: Array
    """Changes at the fitted heights [F], shape (n, K)."""
    error: Array
    """Relative errors of the changes, shape (n, K); NaN where ``own`` is above :data:`CLEAR`."""
    own: Array
    """What of them the laboratory's noise, zero and stage explain, shape (n, K)."""
    gain: Array
    level: Array
    """Of each channel without a body [F], shape (K,)."""
    stray: Array
    """The level less what the simulated board has [F], shape (K,)."""
    zero: dict[str, float]
    """What is added to the stage's heights, by body [m]."""
    tilt: dict[str, tuple[float, float]]
    """Turns about x and y, by body [rad]."""
    uncertainty: dict[str, Any]
    """Standard uncertainties of gain, level, stray, zero and tilt."""
    noise: Array
    """Standard deviation of repeated rows [F], shape (K,)."""
    permittivity: tuple[float, float]
    """Found from the empty board, and its uncertainty; NaN without rows ``open``."""
    verdicts: dict[str, tuple[float, float, str]] = field(default_factory=dict)
    """Value, the laboratory's own share of it, and the verdict, by key of the statement."""


def read_rows(path: str | Path) -> tuple[list[Position], Array]:
    """Positions and measured capacitances [F], shape (n, K), of a file.

    Raises:
        ReadoutError: The header or a row is wrong, or there are no rows.
    """
    path = Path(path)
    if not path.is_file():
        raise ReadoutError(f"there is no file {path}; check the path")
    with path.open(newline="", encoding="utf-8") as stream:
        lines = [(n, line) for n, line in enumerate(stream, 1) if line.strip() and line[0] != "#"]
    table = list(csv.reader(line for _, line in lines))
    header = [name.strip() for name in table[0]] if table else []
    missing = [name for name in COLUMNS if name not in header]
    unknown = [name for name in header if name not in COLUMNS]
    twice = sorted({name for name in header if header.count(name) > 1})
    for names, what in ((missing, "lacks"), (unknown, "has unknown"), (twice, "has twice")):
        if names:
            raise ReadoutError(
                f"{path}: the header {what} {', '.join(names)}; it must be {','.join(COLUMNS)}"
            )
    positions, values = [], []
    for (number, _), row in zip(lines[1:], table[1:], strict=True):
        where = f"{path}, line {number}"
        if len(row) != len(header):
            raise ReadoutError(f"{where}: {len(row)} fields for {len(header)} columns; complete it")
        cells = {name: cell.strip() for name, cell in zip(header, row, strict=True)}
        positions.append(_position(cells, where))
        values.append([1e-12 * _number(cells, f"{name}_pF", where) for name in CHANNELS])
    if not positions:
        raise ReadoutError(f"{path} holds no rows; measure at positions.csv and fill them in")
    return positions, np.array(values)


def _position(cells: dict[str, str], where: str) -> Position:
    for key, known in (
        ("body", (*BODIES, *NO_BODY)),
        ("grounding", (*GROUNDINGS, "none")),
        ("direction", DIRECTIONS),
    ):
        if cells[key] not in known:
            raise ReadoutError(f"{where}: {key} = {cells[key]!r}; give one of {', '.join(known)}")
    x, y, height, cover = (
        1e-3 * _number(cells, key, where) for key in ("x_mm", "y_mm", "height_mm", "cover_mm")
    )
    held = cells["body"] in BODIES
    if held and cells["grounding"] == "none":
        raise ReadoutError(f"{where}: the grounding of {cells['body']} is missing; give it")
    if cover < 0 or (held and not cover < height <= 0.3):
        raise ReadoutError(
            f"{where}: height_mm = {1e3 * height:g} with cover_mm = {1e3 * cover:g}; give a height "
            "above the cover, up to 300 mm"
        )
    return Position(
        cells["body"], x, y, height, cells["grounding"], cover, cells["direction"]
    )  # fmt: skip


def _number(cells: dict[str, str], key: str, where: str) -> float:
    try:
        value = float(cells[key])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ReadoutError(f"{where}: {key} = {cells[key]!r}; give a finite number")
    return value


def board(permittivity: float = FR4, cover: float = 0.0) -> Design:
    """The board, of another permittivity or under a sheet of acrylic of a thickness [m]."""
    content = tomllib.loads((HERE / "board.toml").read_text(encoding="utf-8"))
    (slab,) = content["layer"]
    if permittivity != FR4:
        content["layer"] = [{k: v for k, v in slab.items() if k != "material"}]
        content["layer"][0]["eps_r"] = permittivity
    if cover > 0:
        sheet = {"name": "cover", "material": "acrylic", "size": slab["size"], "z": [0.0, cover]}
        content["layer"] = [*content["layer"], sheet]
    return parse_design(content, source="board.toml")


@cache
def simulator(preset: str, permittivity: float = FR4, cover: float = 0.0) -> cs.Simulator:
    """The simulator of such a board; its field is built once and kept on disk."""
    return cs.Simulator(board(permittivity, cover), preset=preset)  # type: ignore[arg-type]


@cache
def bank() -> ChannelBank:
    """The channels, applied to the board's matrices."""
    return ChannelBank(PATTERNS, board().electrode_names)


def changes(
    positions: Sequence[Position],
    zero: dict[str, float],
    tilt: dict[str, tuple[float, float]],
    preset: str,
    permittivity: float = FR4,
) -> Array:
    """Simulated changes of the channels against the board alone [F], shape (n, K).

    Positions that differ in direction only are simulated once.
    """
    keys = [(p.body, p.x, p.y, p.height, p.grounding, p.cover) for p in positions]
    out: dict[tuple[Any, ...], Array] = {k: np.zeros(len(CHANNELS)) for k in keys}
    held = [k for k in out if k[0] in BODIES]
    for cover in sorted({k[5] for k in held}):
        sim = simulator(preset, permittivity, cover)
        of = [k for k in held if k[5] == cover]
        scenes = [_scene(k, zero.get(k[0], 0.0), tilt.get(k[0], (0.0, 0.0))) for k in of]
        base = values_of(sim.empty)
        for key, reading in zip(of, sim.step_batch(scenes), strict=True):
            out[key] = values_of(reading) - base
    return np.array([out[k] for k in keys])


def values_of(reading: cs.Reading) -> Array:
    """What the channels see of a reading [F], shape (K,)."""
    return np.asarray(bank().values(reading.capacitance, reading.shield_coupling))


def _scene(key: tuple[Any, ...], zero: float, tilt: tuple[float, float]) -> cs.Scene:
    body, x, y, height, grounding, _ = key
    shape, half, (roll, pitch, yaw) = BODIES[body]
    # It turns about the middle of its lowest face, which stays at the height.
    arm = cs.Pose.from_euler((0.0, 0.0, 0.0), (*tilt, 0.0)).rotation @ np.array((0.0, 0.0, half))
    place = np.array((x, y, max(height + zero, 1e-5))) + arm
    pose = cs.Pose.from_euler(place, (roll + tilt[0], pitch + tilt[1], yaw))
    return cs.Scene([cs.Body(shape, pose, material="steel", grounding=GROUNDINGS[grounding])])


def fit(
    positions: list[Position], measured: Array, *, preset: str = "fine", tilted: bool = False
) -> LabFit:
    """Fit gains, levels, zeros and tilts by weighted least squares, and judge the statements.

    Gauss-Newton: ``m = g ΔC(h + zero) + level``, with ΔC linear in zero and tilt between two
    iterations. Uncertainties follow from the residuals, ``χ²/(n − p) (XᵀWX)⁻¹``.

    Args:
        positions: Those of the file, in the order in which they were measured.
        measured: Capacitances [F], shape (n, K).
        preset: How finely bodies are resolved.
        tilted: Whether the plate may be tilted.

    Raises:
        ReadoutError: There are no rows without a body, or too few with one.
    """
    names = [b for b in BODIES if any(p.body == b for p in positions)]
    at_rest = np.array([p.body == "empty" for p in positions])
    loose = np.array([p.body == "open" for p in positions])
    used = ~loose
    if not names or not at_rest.any():
        raise ReadoutError("rows with body = empty, and rows with a body, are needed; measure both")
    measured = _without_drift(positions, measured)
    noise = repeatability(positions, measured)
    k, rows = len(CHANNELS), np.flatnonzero(used)
    covers = sorted({p.cover for p in positions if p.body != "open"})
    bare = [p for p in positions if p.body == "empty"]
    for cover in covers:
        if not any(p.cover == cover for p in bare):
            raise ReadoutError(
                f"there are no rows with body = empty and cover_mm = {1e3 * cover:g}; measure some"
            )
    turns = [b for b in names if tilted and b == TILTED]
    unknowns = k * (1 + len(covers)) + len(names) + 2 * len(turns)
    if len(rows) * k <= unknowns:
        raise ReadoutError(f"{len(rows)} rows for {unknowns} unknowns; measure more")
    zero, tilt = dict.fromkeys(names, 0.0), dict.fromkeys(turns, (0.0, 0.0))
    gain = np.ones(k)
    chosen = [positions[i] for i in rows]
    for _ in range(8):
        true = changes(chosen, zero, tilt, preset)
        slopes = _slopes(chosen, true, zero, tilt, turns, preset)
        weight = 1.0 / np.hypot(noise, MODEL * true)
        design = np.zeros((len(rows), k, unknowns))
        for c in range(k):
            design[:, c, c] = true[:, c]
            for n, cover in enumerate(covers):
                design[:, c, k * (1 + n) + c] = [p.cover == cover for p in chosen]
        for n, slope in enumerate(slopes):
            design[:, :, k * (1 + len(covers)) + n] = gain * slope
        solved, covariance = _solve(design, measured[rows], weight)
        gain, shift = solved[:k], solved[k * (1 + len(covers)) :]
        for n, body in enumerate(names):
            # A height cannot fall below the board: steps are kept to half of the lowest one.
            lowest = min(p.height - p.cover for p in chosen if p.body == body) + zero[body]
            zero[body] += float(np.clip(shift[n], -0.5 * lowest, 2.0 * lowest))
        for n, body in enumerate(turns):
            about = shift[len(names) + 2 * n :][:2]
            tilt[body] = (tilt[body][0] + float(about[0]), tilt[body][1] + float(about[1]))
        if np.abs(shift[: len(names)]).max() < 1e-7:
            break
    else:
        raise ReadoutError("the fit does not settle; check heights and the order of the columns")
    spread = np.sqrt(np.diag(covariance))
    levels = solved[k : k * (1 + len(covers))].reshape(len(covers), k)
    base = values_of(simulator(preset, FR4, covers[0]).empty)
    true = changes(positions, zero, tilt, preset)
    which = np.array([covers.index(p.cover) if p.body != "open" else 0 for p in positions])
    seen = (measured - levels[which]) / gain
    seen[loose] = 0.0
    held = np.array([p.body in BODIES for p in positions])
    size = np.where(true == 0.0, np.inf, np.abs(true))
    slope = np.zeros_like(true)
    slope[rows] = sum(_slopes(chosen, true[rows], zero, tilt, [], preset))
    unsure = {b: float(spread[k * (1 + len(covers)) + n]) for n, b in enumerate(names)}
    doubt = np.array([math.hypot(STAGE, unsure.get(p.body, 0.0)) for p in positions])[:, None]
    own = np.hypot(noise / gain, slope * doubt) / size
    clear = held[:, None] & (own <= CLEAR) & (true != 0.0)
    found = LabFit(
        positions, seen, true, np.where(clear, (seen - true) / size, np.nan), own,
        gain, levels[0], levels[0] - gain * base, zero, tilt,
        {
            "gain": spread[:k],
            "level": spread[k : 2 * k],
            "stray": np.hypot(spread[k : 2 * k], spread[:k] * base),
            "zero": unsure,
            "tilt": {
                b: spread[k * (1 + len(covers)) + len(names) + 2 * n :][:2]
                for n, b in enumerate(turns)
            },
        },
        noise,
        _permittivity(positions, measured, gain, spread[:k], noise, preset),
    )  # fmt: skip
    found.verdicts.update(_verdicts(found))
    return found


def _solve(design: Array, measured: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares: figures and their covariance, by QR of scaled columns."""
    x = (design * weight[..., None]).reshape(-1, design.shape[-1])
    y = (measured * weight).ravel()
    scale = np.sqrt((x**2).sum(axis=0))
    if (scale == 0).any() or np.linalg.cond(x / np.where(scale > 0, scale, 1.0)) > 1e7:
        raise ReadoutError(
            "the rows do not tell gains, levels, zeros and tilts apart; measure at more heights"
        )
    q, r = np.linalg.qr(x / scale)
    solved = np.linalg.solve(r, q.T @ y)
    rest = y - (x / scale) @ solved
    root = np.linalg.inv(r)
    excess = max(1.0, float(rest @ rest) / (len(y) - len(scale)))
    return solved / scale, excess * root @ root.T / np.outer(scale, scale)


def _slopes(
    positions: list[Position], true: Array, zero: dict[str, float],
    tilt: dict[str, tuple[float, float]], turns: list[str], preset: str,
) -> list[Array]:  # fmt: skip
    """How the changes follow each zero [F/m], then each tilt [F/rad], by one-sided differences."""
    lowest = min(p.height - p.cover for p in positions if p.body in BODIES)
    step = 0.02 * lowest
    moved = changes(positions, {b: z + step for b, z in zero.items()}, tilt, preset)
    rows = {b: np.array([[p.body == b] for p in positions]) for b in zero}
    out = [rows[b] * (moved - true) / step for b in zero]
    angle = step / 0.05  # the edge of the plate then moves by the step
    for b in turns:
        for axis in range(2):
            turned = (tilt[b][0] + angle * (axis == 0), tilt[b][1] + angle * (axis == 1))
            moved = changes(positions, zero, {**tilt, b: turned}, preset)
            out.append(rows[b] * (moved - true) / angle)
    return out


def _without_drift(positions: Sequence[Position], measured: Array) -> Array:
    """Values less how the empty board's drift between blocks of rows ``empty``, bare or covered."""
    out = measured.copy()
    order = np.arange(len(positions))
    for cover in {p.cover for p in positions}:
        here = np.array([p.cover == cover and p.body != "open" for p in positions])
        rests = here & np.array([p.body == "empty" for p in positions])
        blocks = []
        for rest, group in groupby(order, rests.__getitem__):
            if rest:
                members = list(group)
                blocks.append((float(np.mean(members)), measured[members].mean(axis=0)))
        if len(blocks) > 1:
            at, levels = np.array([b[0] for b in blocks]), np.array([b[1] for b in blocks])
            for c in range(measured.shape[1]):
                drift = np.interp(order, at, levels[:, c]) - levels[:, c].mean()
                out[here, c] -= drift[here]
    return out


def repeatability(positions: Sequence[Position], measured: Array) -> Array:
    """Standard deviation of rows of the empty board within a block [F], shape (K,).

    Raises:
        ReadoutError: No block has two rows.
    """
    squares, count = np.zeros(measured.shape[1]), 0
    order = range(len(positions))
    for (body, _), group in groupby(order, lambda i: (positions[i].body, positions[i].cover)):
        members = list(group)
        if body == "empty" and len(members) > 1:
            squares += ((measured[members] - measured[members].mean(axis=0)) ** 2).sum(axis=0)
            count += len(members) - 1
    if not count:
        raise ReadoutError("no two rows in succession have body = empty; measure the empty board "
                           "several times")  # fmt: skip
    return np.maximum(np.sqrt(squares / count), 1e-18)


def _permittivity(
    positions: Sequence[Position], measured: Array, gain: Array, unsure: Array, noise: Array,
    preset: str,
) -> tuple[float, float]:  # fmt: skip
    """FR-4's permittivity, from the empty board less the cables alone.

    The mean of the self channels, weighted by their uncertainty; NaN without rows ``open``.
    """
    loose = np.array([p.body == "open" for p in positions])
    bare = np.array([p.body == "empty" and p.cover == 0 for p in positions])
    if not loose.any() or not bare.any():
        return math.nan, math.nan
    own = (measured[bare].mean(axis=0) - measured[loose].mean(axis=0)) / gain
    base = values_of(simulator(preset).empty)
    more = values_of(simulator(preset, STEP * FR4).empty)
    per = (more - base) / ((STEP - 1.0) * FR4)
    selves = [k for k, p in enumerate(PATTERNS) if p.is_self]
    each = FR4 + (own - base)[selves] / per[selves]
    sure = np.hypot(noise, unsure * base)[selves] / np.abs(per[selves])
    weights = sure**-2 / (sure**-2).sum()
    # The gains share the solver's scale, so that the channels' errors are not independent.
    return float(weights @ each), float(weights @ sure)


def _verdicts(found: LabFit) -> dict[str, tuple[float, float, str]]:
    """Of each statement: confirmed, refuted, undecided, or not measured."""
    out = {}
    for statement in STATEMENTS:
        value, own = _value(found, statement.key)
        if math.isnan(value):
            verdict = "not measured"
        elif own > statement.limit:
            verdict = "undecided: the laboratory's own share is above the limit"
        elif value <= statement.limit:
            verdict = "confirmed"
        elif value**2 - own**2 > statement.limit**2:
            verdict = "REFUTED"
        else:
            verdict = "undecided: above the limit by no more than the laboratory's own share"
        out[statement.key] = (value, own, verdict)
    return out


def _value(found: LabFit, key: str) -> tuple[float, float]:
    """What a statement is about, and the laboratory's own share; NaN if it was not measured."""
    big = ("L", "M", "T")
    if key == "near":
        return rms(found, big, "grounded", RANGES[:1])
    if key == "near small":
        return rms(found, ("S",), "grounded", RANGES[:1])
    if key == "far":
        return rms(found, ("L", "M", "S", "T"), "grounded", RANGES[1:])
    if key == "mutual":
        return rms(found, ("TR",), "grounded", RANGES)
    if key == "cover":
        return rms(found, big, "grounded", RANGES, covered=True)
    if key in ("floating", "tied"):
        return _ratios(found, big, "floating" if key == "floating" else "100pF")
    if key == "scale":
        unsure = float(found.uncertainty["gain"][0])
        return abs(float(found.gain[0]) - 1.0), math.hypot(CHIP_GAIN, unsure)
    if key == "permittivity":
        value, unsure = found.permittivity
        return abs(value - FR4) / FR4, unsure / FR4
    selves = [k for k, p in enumerate(PATTERNS) if p.is_self]
    told = float(np.median(found.noise[selves])) / chip_noise()
    rows = sum(p.body == "empty" for p in found.positions)
    return abs(math.log2(told)), 1.0 / math.sqrt(2 * max(rows - 1, 1)) / math.log(2)


def _chosen(
    found: LabFit, grounding: str, ranges: Iterable[tuple[float, float]], covered: bool = False
) -> NDArray[np.bool_]:
    return np.array([
        p.body in BODIES and p.grounding == grounding and (p.cover > 0) == covered
        and any(low < p.height <= high for low, high in ranges)
        for p in found.positions
    ])  # fmt: skip


def rms(
    found: LabFit, channels: Sequence[str], grounding: str,
    ranges: Iterable[tuple[float, float]], *, covered: bool = False,
) -> tuple[float, float]:  # fmt: skip
    """Root of the mean square of the relative errors, and of the laboratory's own share."""
    rows = _chosen(found, grounding, tuple(ranges), covered)
    columns = [CHANNELS.index(name) for name in channels]
    clear = rows[:, None] & np.isin(np.arange(len(CHANNELS)), columns) & ~np.isnan(found.error)
    if not clear.any():
        return math.nan, math.nan
    error, own = (float(np.sqrt((t[clear] ** 2).mean())) for t in (found.error, found.own))
    return error, own


def _ratios(found: LabFit, channels: Sequence[str], grounding: str) -> tuple[float, float]:
    """Error of what a body not grounded changes, over what it changes where it is grounded."""
    columns = [CHANNELS.index(name) for name in channels]
    sums: dict[tuple[Any, ...], dict[str, list[int]]] = {}
    for i in np.flatnonzero(_chosen(found, grounding, RANGES[:2])).tolist():
        p = found.positions[i]
        sums.setdefault((p.body, p.x, p.y, p.height), {}).setdefault("other", []).append(i)
    for i in np.flatnonzero(_chosen(found, "grounded", RANGES[:2])).tolist():
        p = found.positions[i]
        if (p.body, p.x, p.y, p.height) in sums:
            sums[p.body, p.x, p.y, p.height].setdefault("ground", []).append(i)
    errors, shares = [], []
    for rows in sums.values():
        if len(rows) < 2:
            continue
        true, seen, own = (
            {k: t[r][:, columns].mean(axis=0) for k, r in rows.items()}
            for t in (found.simulated, found.measured, found.own)
        )
        share = np.hypot(own["other"], own["ground"])
        with np.errstate(divide="ignore", invalid="ignore"):
            error = seen["other"] / seen["ground"] - true["other"] / true["ground"]
        errors.append(error[share <= CLEAR])
        shares.append(share[share <= CLEAR])
    if not errors or not np.concatenate(errors).size:
        return math.nan, math.nan
    return tuple(  # type: ignore[return-value]
        float(np.sqrt((np.concatenate(v) ** 2).mean())) for v in (errors, shares)
    )


@cache
def chip_noise(seconds: int = 60) -> float:
    """Standard deviation of means over 1 s of the FDC1004's preset at rest, 100 per second [F]."""
    chip = cs.Readout.preset("fdc1004", ("E1",), rate=100, seed=1)
    chip.reset()
    still = np.array([[12e-12]])
    means = [chip.sample(float(t), still).capacitance.mean() for t in range(1, seconds + 1)]
    # Neighbours, as repeated rows are: slow drift counts for little.
    return float(np.sqrt((np.diff(means) ** 2).mean() / 2))


def report(found: LabFit) -> str:
    """Figures of the fit, the table of errors and the verdicts, as text."""
    lines = ["channel  gain               stray [pF]         noise [fF]"]
    for k, name in enumerate(CHANNELS):
        lines.append(
            f"{name:7s}  {found.gain[k]:.4f} ± {found.uncertainty['gain'][k]:.4f}    "
            f"{1e12 * found.stray[k]:+.4f} ± {1e12 * found.uncertainty['stray'][k]:.4f}   "
            f"{1e15 * found.noise[k]:.3f}"
        )
    for body, zero in found.zero.items():
        tail = ""
        if body in found.tilt:
            turns = zip(found.tilt[body], found.uncertainty["tilt"][body], strict=True)
            tail = ", tilt " + " and ".join(f"{1e3 * a:+.3f} ± {1e3 * u:.3f}" for a, u in turns)
            tail += " mrad"
        lines.append(
            f"zero of {body}: {1e6 * zero:+.1f} ± {1e6 * found.uncertainty['zero'][body]:.1f} µm"
            + tail
        )
    heads = [f"{1e3 * low:g}-{1e3 * high:g} mm" for low, high in RANGES]
    lines += ["", "rms | worst error in % of grounded, floating and tied bodies without a cover,",
              f"where the laboratory's own share is below {100 * CLEAR:g} %",
              "channel  all            " + "  ".join(f"{h:15s}" for h in heads)]  # fmt: skip
    bare = np.array([p.body in BODIES and p.cover == 0 for p in found.positions])
    height = np.array([p.height for p in found.positions])
    for k, name in enumerate(CHANNELS):
        cells = []
        for low, high in ((0.0, math.inf), *RANGES):
            e = 100 * found.error[bare & (height > low) & (height <= high), k]
            e = e[~np.isnan(e)]
            cells.append(
                f"{np.sqrt((e**2).mean()):5.2f} | {np.abs(e).max():5.2f}  " if e.size else "-"
            )
        lines.append(f"{name:7s}  " + "  ".join(f"{c:15s}" for c in cells))
    lines += ["", "statement: value (laboratory's own share), limit: verdict"]
    for s in STATEMENTS:
        value, own, verdict = found.verdicts[s.key]
        lines.append(f"{s.text}: {value:.4f} ({own:.4f}), {s.limit:g}: {verdict}")
    if not math.isnan(found.permittivity[0]):
        lines.append("permittivity of FR-4: {:.3f} ± {:.3f}".format(*found.permittivity))
    return "\n".join(lines)


def plot(found: LabFit, path: Path) -> None:
    """Changes against height, and errors with the laboratory's own share."""
    import capsense.plotting  # noqa: F401  # its style sheet

    with plt.style.context("capsense.plotting.capsense"):
        figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
        grounded = _chosen(found, "grounded", RANGES)
        height = 1e3 * np.array([p.height for p in found.positions])
        bodies = [b for b in BODIES if b in found.zero]
        for k, name in enumerate(CHANNELS):
            plate = grounded & np.array([p.body == bodies[0] for p in found.positions])
            order = np.argsort(height[plate], kind="stable")
            x = height[plate][order]
            left.plot(x, 1e15 * np.abs(found.simulated[plate, k][order]), color=f"C{k}", lw=1)
            left.plot(x, 1e15 * np.abs(found.measured[plate, k][order]), ".", color=f"C{k}",
                      label=f"{name}", ms=5)  # fmt: skip
            for n, body in enumerate(bodies):
                mine = grounded & np.array([p.body == body for p in found.positions])
                right.plot(height[mine], 100 * found.error[mine, k], "oxs"[n], color=f"C{k}", ms=4,
                           fillstyle="none", mew=0.8)  # fmt: skip
        for n, body in enumerate(bodies):
            right.plot([], [], "oxs"[n], color="0.3", ms=4, fillstyle="none", label=body)
        for limit, low, high in ((3, height[grounded].min(), 5), (2, 5, height[grounded].max())):
            right.fill_between([low, high], -limit, limit, color="0.9", lw=0, zorder=0)
        left.set(xscale="log", yscale="log", xlabel="height [mm]", ylabel="|change of C| [fF]",
                 title=f"{bodies[0]}, grounded: measured (dots), simulated")  # fmt: skip
        right.set(xscale="log", xlabel="height [mm]", ylabel="error [%]",
                  title="grounded: errors; grey: limits of L, M and T")  # fmt: skip
        # Below the noise a logarithmic axis shows nothing of use.
        left.set_ylim(bottom=0.5e15 * found.noise.min())
        for axes in (left, right):
            axes.xaxis.set_major_formatter("{x:g}")
        left.legend(ncols=2)
        right.legend()
        figure.savefig(path)
        plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> LabFit:
    """Read a file, fit, print and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("measured", type=Path, help="the file, with the columns of measured.csv")
    parser.add_argument("-o", "--out", type=Path, default=Path("out"), help="folder of the plot")
    parser.add_argument("--preset", default="fine", choices=("fast", "standard", "fine"))
    parser.add_argument("--tilt", action="store_true", help="fit the tilt of the plate too")
    options = parser.parse_args(arguments)
    try:
        positions, measured = read_rows(options.measured)
        found = fit(positions, measured, preset=options.preset, tilted=options.tilt)
    except CapSenseError as error:
        raise SystemExit(f"error: {error}") from None
    print(report(found))
    options.out.mkdir(parents=True, exist_ok=True)
    plot(found, options.out / "experiment.png")
    print(f"\nplot: {options.out / 'experiment.png'}")
    return found


if __name__ == "__main__":
    main()
