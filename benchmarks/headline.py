"""The headline figures of README and docs, from one run, in one file.

    python benchmarks/headline.py                  # measure; write docs/figures.json, the pages
    python benchmarks/headline.py --only presets near
    python benchmarks/headline.py --write          # pages and picture only, from the file
    python benchmarks/headline.py --check          # is the file of this code, are the pages of it?

Each part is a benchmark that leaves its results in ``out/headline``. A run that was interrupted
goes on: parts that were measured on the same sources of the package are not measured again, unless
``--again`` asks for it. Run it on a quiet machine with two cores; it takes about a quarter of an
hour. A page has a table where it says ``<!-- figures: NAME -->``; names are those of
``headline_tables.TABLES``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

from headline_tables import FIGURES, TABLES, Figures, load
from machine import describe_machine
from pages import between, replaced

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out" / "headline"
PICTURE = ROOT / "docs" / "images" / "accuracy_time.png"
END = "<!-- end of figures -->"
PRESETS = "fast", "standard", "fine"
NEAR_KEYS = "rms", "p95", "worst"
Found = dict[str, tuple[float, str]]
"""Name → value and unit."""


class Part(NamedTuple):
    """A benchmark, and what is taken from its results."""

    command: str
    """As a user writes it; ``-o FILE.json`` is added."""
    figures: Callable[[Any], Found]
    """From its results."""


def of_presets(data: Any) -> Found:
    """Error and step of each preset, from ``accuracy_map.py``."""
    out: Found = {}
    for row in data["results"]:
        name = row["label"].split()[-1]
        for key in NEAR_KEYS:
            out[f"{name}/{key}"] = row["all"][key], "%"
        out[f"{name}/step"] = row["all"]["ms"], "ms"
        out["scenes"] = row["all"]["scenes"], "1"
    return out


def of_bodies(data: Any) -> Found:
    """What 95 % of the errors stay below, from ``accuracy_guide.py``."""
    return {name: (value, "%") for name, value in data["p95"].items()}


def of_near(data: Any) -> Found:
    """Errors in the first millimetres, from ``near_map.py``."""
    out: Found = {}
    for result in data["results"]:
        preset = result["preset"]
        for name, row in result["designs"].items():
            out[f"{name}/scenes"] = row["scenes"], "1"
            for key in NEAR_KEYS:
                out[f"{name}/{preset}/{key}"] = row["diagonal"][key], "%"
        near = result["near"]
        out["near/scenes"] = near["scenes"], "1"
        for key in NEAR_KEYS:
            out[f"near/{preset}/{key}"] = near["beyond"][key], "%"
        out[f"near/{preset}/mutual"] = near["mutual_beyond"]["rms"], "%"
        out[f"near/{preset}/covered"] = 100 * result["all"]["covered"], "%"
        out[f"near/{preset}/ratio"] = result["all"]["worst_ratio"], "1"
        out[f"near/{preset}/wrong_signs"] = result["all"]["wrong_signs"], "1"
    return out


def of_held_out(data: Any) -> Found:
    """The same of scenes that nothing was chosen on: no designs."""
    return {name: value for name, value in of_near(data).items() if name.startswith("near/")}


def of_difficult(data: Any) -> Found:
    """Errors of difficult bodies, from ``difficult.py``."""
    return {name: (value, "1" if name.endswith("scenes") else "%") for name, value in
            data["kinds"].items()}  # fmt: skip


def of_steps(data: Any) -> Found:
    """Times of steps, batches and set-up, from ``steps.py``."""
    out: Found = {}
    for world, methods in data["steps"].items():
        for name, row in methods.items():
            out[f"{world}/{name}/step"] = row["median_ms"], "ms"
            if row["off"] is not None:
                out[f"{world}/{name}/off"] = 100 * row["off"], "%"
        out[f"{world}/unknowns"] = methods["standard"]["unknowns"], "1"
        out[f"{world}/standard/p95"] = methods["standard"]["p95_ms"], "ms"
    for name, rate in data.get("batches", {}).items():
        out[f"batch/{name}"] = rate, "scenes/s"
    for shape, ms in data.get("shapes_ms", {}).items():
        out[f"set-up/{shape}"] = ms, "ms"
    for name, row in zip(("mesh", "mesh again"), data.get("mesh", ()), strict=False):
        out[f"set-up/{name}"] = row["first_s"], "s"
    for name, seconds in data.get("first_reading_s", {}).items():
        out[f"first reading/{name}"] = seconds, "s"
    return out


def of_fleet(data: Any) -> Found:
    """Rates of fleets on the CPU, from ``fleet.py``."""
    return {name: (value, "solves/s") for name, value in data["rates"].items()}


def of_skin(data: Any) -> Found:
    """Steps of sixteen curved sensors, from ``skin.py``."""
    return {f"threads/{threads}": (ms, "ms") for threads, ms in data["step_ms"].items()}


PARTS = {
    "presets": Part(
        "python benchmarks/accuracy_map.py --scenes map --presets fast standard fine --worst 0",
        of_presets,
    ),
    "bodies": Part("python benchmarks/accuracy_guide.py", of_bodies),
    "near": Part(
        "python benchmarks/near_map.py --presets fast standard fine --worst 0", of_near
    ),
    "held_out": Part(
        "python benchmarks/near_map.py --presets fast standard fine --worst 0 "
        "--data tests/data/near_held_out.json",
        of_held_out,
    ),
    "difficult": Part("python benchmarks/difficult.py", of_difficult),
    "steps": Part("python benchmarks/steps.py --steps 60", of_steps),
    "fleet": Part("python benchmarks/fleet.py --counts 4096", of_fleet),
    "skin": Part("python benchmarks/skin.py --only steps", of_skin),
}  # fmt: skip
"""In the order in which they are measured."""


def code() -> str:
    """Digest of the sources of the package."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "src" / "capsense").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def measure(name: str, again: bool, extra: tuple[str, ...] = ()) -> dict[str, Any]:
    """A part's entry of the file, measured now unless ``out/headline`` has it of this code."""
    part, kept, results = PARTS[name], OUT / f"{name}.entry.json", OUT / f"{name}.json"
    if kept.exists() and not again and not extra:
        entry: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
        if (entry["code"], entry["command"]) == (code(), part.command):
            print(f"{name}: measured already on this code")
            return entry
    OUT.mkdir(parents=True, exist_ok=True)
    machine, started = describe_machine(("numpy", "numba")), time.perf_counter()
    log = OUT / f"{name}.log"
    print(f"{name}: {part.command}; prints to {log}", flush=True)
    command = [sys.executable, *part.command.split()[1:], "-o", results.as_posix(), *extra]
    with log.open("w", encoding="utf-8") as stdout:
        done = subprocess.run(command, cwd=ROOT, check=False, stdout=stdout)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed with {done.returncode}")
    found = part.figures(json.loads(results.read_text(encoding="utf-8")))
    entry = {
        "command": " ".join((part.command, *extra)),
        "date": date.today().isoformat(),
        "machine": f"{machine['processor']}, {machine['cores']} cores",
        "load": round(machine["load"], 1),
        "code": code(),
        "figures": {k: {"value": float(f"{v:.4g}"), "unit": u} for k, (v, u) in found.items()},
    }
    kept.write_text(json.dumps(entry, indent=1) + "\n", encoding="utf-8")
    print(f"{name}: {len(found)} figures in {time.perf_counter() - started:.0f} s", flush=True)
    return entry


def save(figures: Figures, path: Path = FIGURES) -> None:
    """Write the file, a line a figure."""
    parts = []
    for name in (p for p in PARTS if p in figures):
        entry = figures[name]
        head = "".join(f"  {json.dumps(k)}: {json.dumps(entry[k])},\n" for k in entry if
                       k != "figures")  # fmt: skip
        rows = ",\n".join(f"   {json.dumps(k)}: {json.dumps(v)}"
                          for k, v in entry["figures"].items())  # fmt: skip
        parts.append(f' {json.dumps(name)}: {{\n{head}  "figures": {{\n{rows}\n  }}\n }}')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def pages() -> list[Path]:
    """Pages that may have tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(text: str) -> dict[str, str]:
    """What a page has for each table that it names."""
    named = re.findall(r"^<!-- figures: (\S+) -->$", text, flags=re.MULTILINE)
    return {name: between(text, (f"<!-- figures: {name} -->", END)) for name in named}


def filled(text: str, figures: Figures) -> str:
    """The page with its tables made anew; an unknown table is refused by its name."""
    for name in blocks(text):
        if name not in TABLES:
            raise SystemExit(f"there is no table {name!r}; choose from {', '.join(TABLES)}")
        text = replaced(text, (f"<!-- figures: {name} -->", END), TABLES[name](figures))
    return text


def write_pages(figures: Figures) -> list[Path]:
    """Write the tables into all pages; those that changed."""
    changed = []
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if (new := filled(text, figures)) != text:
            path.write_text(new, encoding="utf-8")
            changed.append(path)
    return changed


def draw(figures: Figures) -> None:
    """Draw error against time of the presets, as on the performance page."""
    import accuracy_map

    found = {name: figure["value"] for name, figure in figures["presets"]["figures"].items()}
    results = [
        {"label": f"surface {name}",
         "all": {**{k: found[f"{name}/{k}"] for k in NEAR_KEYS}, "ms": found[f"{name}/step"]}}
        for name in PRESETS
    ]  # fmt: skip
    accuracy_map.plot(results, PICTURE)


def check(figures: Figures) -> list[str]:
    """What is wrong with file and pages."""
    wrong = [f"{name} is of other code" for name in PARTS if figures[name]["code"] != code()]
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if filled(text, figures) != text:
            wrong.append(f"{path.relative_to(ROOT)} differs from {FIGURES.name}; use --write")
    return wrong


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    parser.add_argument("--again", action="store_true", help="measure what is there of this code")
    parser.add_argument("--write", action="store_true", help="pages and picture only")
    parser.add_argument("--check", action="store_true", help="say what is out of date; exit with 1")
    args = parser.parse_args()
    figures = load() if FIGURES.exists() else {}
    if args.check:
        if wrong := check(figures):
            raise SystemExit("\n".join(wrong))
        return
    if not args.write:
        for place, name in enumerate(args.only):
            print(f"part {place + 1} of {len(args.only)}", flush=True)
            figures[name] = measure(name, args.again)
            save(figures)
    draw(figures)
    for path in write_pages(figures):
        print(f"wrote {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
