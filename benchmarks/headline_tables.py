"""Tables of ``docs/figures.json`` in Markdown; ``headline.py`` puts them into pages."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

FIGURES = Path(__file__).parents[1] / "docs" / "figures.json"
Figures = dict[str, dict[str, Any]]
"""Part → its command, date, machine, code and figures."""
PRESETS = "fast", "standard", "fine"
QUOTED = tuple(f'`"{preset}"`' for preset in PRESETS)
NONE = "–"
WORTH_A_LINE = 5.0
"""Designs with larger errors near contact have a line of their own [%]."""
DESIGNS = {
    "pad10": "10 mm pad on a board over ground",
    "pad3": "3 mm pad on a board",
    "pad30": "30 mm pad on a board",
    "six_patch_bare": "six bare pads of 30 mm",
    "bare5": "bare 5 mm pads",
    "txrx": "transmitter and receiver under a cover",
    "comb": "comb, 1 mm fingers",
    "pad10c01": "10 mm pad under 0.1 mm of cover",
    "pour10": "two pads in a pour",
    "stripes1": "bare 1 mm stripes",
    "pad60": "bare 60 mm pads",
    "pad150": "bare 150 mm pad",
    "open20": "20 mm pads in the open",
    "small30": "5 mm pads in a box of 30 mm",
    "box2m": "30 mm pads in a box of 2 m",
}
"""Designs of the near map, in words."""


def load(path: Path = FIGURES) -> Figures:
    """The file."""
    found: Figures = json.loads(path.read_text(encoding="utf-8"))
    return found


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(line) + " |" for line in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


class _Part:
    """Values of a part, as text."""

    def __init__(self, figures: Figures, name: str) -> None:
        self.entry = figures[name]
        self.found: dict[str, dict[str, Any]] = self.entry["figures"]

    def text(self, name: str, form: str = ".1f") -> str:
        """A value, or a dash where there is none."""
        return format(self.found[name]["value"], form) if name in self.found else NONE

    def row(self, names: Sequence[str], form: str = ".1f", between: str = "/") -> str:
        """Values beside each other, or a dash."""
        if not any(name in self.found for name in names):
            return NONE
        return between.join(self.text(name, form) for name in names)

    def first(self) -> list[str]:
        """The first words of all names, in order."""
        return list(dict.fromkeys(name.partition("/")[0] for name in self.found))

    def source(self) -> str:
        """Command, date and machine."""
        entry = self.entry
        return f"*`{entry['command']}`, {entry['date']}, {entry['machine']}.*"


def milliseconds(part: _Part, name: str) -> str:
    """A time with two significant digits."""
    if name not in part.found:
        return NONE
    value = part.found[name]["value"]
    return f"{value:.0f}" if value >= 10 else f"{value:.2f}" if value < 1 else f"{value:.1f}"


def presets(figures: Figures) -> str:
    """Error and time of each preset."""
    part = _Part(figures, "presets")
    rows = [
        [quoted, *(f"{part.text(f'{name}/{key}')} %" for key in ("rms", "p95", "worst")),
         f"{milliseconds(part, f'{name}/step')} ms"]
        for quoted, name in zip(QUOTED, PRESETS, strict=True)
    ]  # fmt: skip
    head = ("preset", "rms error", "95 % below", "worst", "median step")
    return f"{table(head, rows)}\n\n{part.source()}"


def near(figures: Figures) -> str:
    """Errors within 5 mm, in a sentence."""
    part = _Part(figures, "near")
    rms, p95, worst = (part.text(f"near/standard/{key}") for key in ("rms", "p95", "worst"))
    return (
        f"Within 5 mm, over {len(DESIGNS)} designs, the errors of the default preset are "
        f"{rms} % rms, 95 % below {p95} %, worst {worst} %, beyond those of the references."
    )


def bodies(figures: Figures) -> str:
    """What 95 % of the errors stay below, by body and distance."""
    part = _Part(figures, "bodies")
    names = [name.split("/") for name in part.found]
    gaps = list(dict.fromkeys(gap for _, gap, _ in names))
    groups = list(dict.fromkeys(group for group, _, _ in names))
    order = sorted(gaps, key=lambda gap: float(gap.split()[0]))
    rows = [
        [group, *(part.row([f"{group}/{gap}/{p}" for p in PRESETS]) for gap in order)]
        for group in groups
    ]
    return f"{table(('', *order), rows)}\n\n{part.source()}"


def near_designs(figures: Figures) -> str:
    """The largest errors within 5 mm by design, and how many designs stay below."""
    part = _Part(figures, "near")
    names = [name for name in part.first() if name != "near"]
    shown = [n for n in names if part.found[f"{n}/standard/worst"]["value"] > WORTH_A_LINE]
    rows = [
        [DESIGNS.get(name, name),
         *(part.row([f"{name}/{p}/{key}" for p in PRESETS], form)
           for key, form in (("rms", ".1f"), ("worst", ".0f")))]
        for name in shown
    ]  # fmt: skip
    rest = (
        f"The other {len(names) - len(shown)} designs, default preset: "
        f"at most {WORTH_A_LINE:.0f} %."
    )
    return f"{table(('design', 'rms, %', 'worst, %'), rows)}\n\n{rest}\n\n{part.source()}"


def held_out(figures: Figures) -> str:
    """Errors within 5 mm of scenes that nothing was chosen on, in a sentence."""
    part = _Part(figures, "held_out")
    rms, p95, worst = (
        part.row([f"near/{p}/{key}" for p in PRESETS]) for key in ("rms", "p95", "worst")
    )
    return (
        f"Over {part.text('near/scenes', '.0f')} other scenes, on which nothing but the threshold "
        f'of `"fast"` was chosen, beyond the errors of the references: {rms} % rms, 95 % below '
        f"{p95} %, worst {worst} %."
        f"\n\n{part.source()}"
    )


def difficult(figures: Figures) -> str:
    """Errors of difficult bodies."""
    part = _Part(figures, "difficult")
    rows = [
        [kind, *(part.row([f"{kind}/{p}/{key}" for p in PRESETS]) for key in ("rms", "worst"))]
        for kind in part.first()
    ]
    return f"{table(('bodies', 'rms, %', 'worst, %'), rows)}\n\n{part.source()}"


def _worlds(part: _Part) -> Iterator[str]:
    """Names of the worlds of ``steps.py``."""
    ends = "/unknowns"
    return (name.removesuffix(ends) for name in part.found if name.endswith(ends))


def steps(figures: Figures) -> str:
    """Times of steps by world."""
    part = _Part(figures, "steps")
    rows = []
    for world in _worlds(part):
        times = (milliseconds(part, f"{world}/{p}/step") for p in PRESETS)
        rows.append([world, *times, part.row([f"{world}/{p}/off" for p in ("fast", "standard")])])
    head = ("world", *QUOTED, "off, %")
    paper = [f["value"] for name, f in part.found.items() if name.endswith("/fem_masked/step")]
    told = f"The paper's scheme takes {min(paper):.0f} to {max(paper):.0f} ms."
    return f"{table(head, rows)}\n\n{told}\n\n{part.source()}"


def rates(figures: Figures) -> str:
    """Batches, fleets and skins."""
    part, fleet, skin = (_Part(figures, name) for name in ("steps", "fleet", "skin"))
    batch = "/".join(_rounded(part, f"batch/{name}") for name in PRESETS)
    solves = "/".join(_rounded(fleet, f"{name}/4096") for name in PRESETS[:2])
    threads = "/".join(name.rpartition("/")[2] for name in skin.found)
    rows = [
        ["256 random scenes of one body, two threads", f"{batch} scenes a second"],
        ["fleet of 4,096 environments, a finger in each", f"{solves} solves a second"],
        [f"sixteen curved sensors around an arm beside a hand, {threads} threads",
         f"{skin.row(list(skin.found))} ms a step"],
    ]  # fmt: skip
    sources = "\n".join(p.source() for p in (part, fleet, skin))
    return f"{table(('', 'wall-clock time'), rows)}\n\n{sources}"


def _rounded(part: _Part, name: str) -> str:
    """A rate with three significant digits."""
    return f"{float(part.text(name, '.3g')):,.0f}"


def set_up(figures: Figures) -> str:
    """What is done once."""
    part = _Part(figures, "steps")
    rows = [[name.partition("/")[2], f"{milliseconds(part, name)} ms"]
            for name, found in part.found.items()
            if name.startswith("set-up/") and found["unit"] == "ms"]  # fmt: skip
    for name, title in (
        ("set-up/mesh", "a mesh of 20,480 triangles, first reading"),
        ("set-up/mesh again", "the same in a later process"),
        ("first reading/cold", "a process to its first reading, kernels not yet compiled"),
        ("first reading/warm", "the same with compiled kernels"),
    ):
        rows.append([title, f"{part.text(name, '.2g')} s"])
    return f"{table(('', 'processor time'), rows)}\n\n{part.source()}"


TABLES: dict[str, Callable[[Figures], str]] = {
    "presets": presets,
    "near": near,
    "bodies": bodies,
    "near-designs": near_designs,
    "held-out": held_out,
    "difficult": difficult,
    "steps": steps,
    "rates": rates,
    "set-up": set_up,
}
"""By the names that pages use."""
