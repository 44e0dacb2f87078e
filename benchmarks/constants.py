"""The numerical constants of the solver, from its source, and their number in the docs.

    python benchmarks/constants.py                              # print the table
    python benchmarks/constants.py --write docs/theory.md       # replace the summary of a page
    python benchmarks/constants.py --literals                   # numbers inside functions

Listed are the module-level names in capitals that hold numbers, or tuples of numbers, and the
default values of the settings classes. ``constants.toml`` says what each one is.
"""

from __future__ import annotations

import argparse
import ast
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from headline_tables import table as markdown_table
from pages import write_between

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parent / "src" / "capsense"
PACKAGES = "solver", "field"
SETTINGS = "Preset", "GreenSettings", "Accuracy"
"""Classes whose default values count as constants."""
NOTES = HERE / "constants.toml"
START, END = "<!-- constants -->", "<!-- end of constants -->"
_NAME = re.compile(r"_?[A-Z][A-Z0-9_]*")
_TRIVIAL = {0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0}
"""Numbers in formulas that are not counted."""


class Constant(NamedTuple):
    """A constant of the source."""

    module: str
    """Its module, such as ``solver.system.step``."""
    name: str
    value: str
    """As the source has it."""
    text: str
    """The docstring below it, on one line."""

    @property
    def key(self) -> str:
        """Its full name."""
        return f"{self.module}.{self.name}"


def _module(path: Path) -> str:
    """Name of a module below the package, such as ``solver.system.step``."""
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts)


def constants() -> list[Constant]:
    """All constants of the solver, in the order of the source."""
    out: list[Constant] = []
    for package in PACKAGES:
        for path in sorted((SOURCE / package).rglob("*.py")):
            module, tree = _module(path), ast.parse(path.read_text(encoding="utf-8"))
            out += _of_body(module, tree.body, _NAME.fullmatch)
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and node.name in SETTINGS:
                    found = _of_body(module, node.body, str.isidentifier)
                    out += [c._replace(name=f"{node.name}.{c.name}") for c in found]
    return out


def literals() -> Counter[str]:
    """How many numbers other than those of simple formulas are written inside functions."""
    out: Counter[str] = Counter()
    for package in PACKAGES:
        for path in sorted((SOURCE / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    out[_module(path)] += sum(
                        isinstance(n, ast.Constant)
                        and isinstance(n.value, float)
                        and n.value not in _TRIVIAL
                        for n in ast.walk(node)
                    )
    return +out


def notes() -> dict[str, dict[str, Any]]:
    """What ``constants.toml`` says, by full name."""
    return tomllib.loads(NOTES.read_text(encoding="utf-8"))


def tuned() -> list[Constant]:
    """Those that were chosen."""
    known = notes()
    return [c for c in constants() if known[c.key]["kind"] == "tuned"]


def table() -> str:
    """The table of the tuned constants, in Markdown."""
    known = notes()
    rows = []
    for c in tuned():
        note = known[c.key]
        unit = "–" if note["unit"] == "1" else note["unit"]
        origin = "; ".join(filter(None, (note["origin"], note.get("sensitivity"))))
        rows.append([f"`{c.module}.{c.name}`", c.value, unit, note["meaning"], origin])
    head = ("constant", "value", "unit, or ratio to", "meaning", "origin, sensitivity")
    return markdown_table(head, rows)


def summary() -> str:
    """How many constants there are, by origin or kind."""
    known = notes()
    origins = Counter(str(known[c.key]["origin"]) for c in tuned())
    kinds = Counter(str(known[c.key]["kind"]) for c in constants())
    chosen = "; ".join(f"{origins[name]} {text} (*{name}*)" for name, text in ORIGINS.items())
    others = ", ".join(f"{kinds[name]} {text}" for name, text in OTHERS.items())
    return f"**{origins.total()} constants are tuned**: {chosen}. Not tuned: {others}."


OTHERS = {
    "precision": "tolerances of rounding and of iterations",
    "capacity": "buffer sizes and limits of memory or of loops",
    "code": "version numbers and codes",
    "exact": "exact numbers of formulas",
}
"""Kinds that are not tuned, in words."""
ORIGINS = {
    "formula": "follow from an ideal case",
    "reference": "were set or checked by reference solutions",
    "margin": "are bounds that regular scenes do not reach",
    "choice": "are choices of resolution or range, without a record of how they were found",
}
"""Origins of tuned ones, in words."""


def _of_body(module: str, body: list[ast.stmt], wanted: Any) -> Iterator[Constant]:
    for place, node in enumerate(body):
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        text = ""
        after = body[place + 1] if place + 1 < len(body) else None
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            text = " ".join(str(after.value.value).split())
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
        for one, number in pairs:
            if not isinstance(one, ast.Name) or not wanted(one.id):
                continue
            if _is_number(number):
                yield Constant(module, one.id, _shown(number), text)
            elif isinstance(number, ast.Dict):
                for label, choice in zip(number.keys, number.values, strict=True):
                    yield from _of_call(module, one.id, label, choice, text)


def _of_call(
    module: str, name: str, label: ast.expr | None, choice: ast.expr, text: str
) -> Iterator[Constant]:
    """Numbers of one entry of a dictionary of settings, such as ``"fine": Preset(panels=1000)``."""
    if isinstance(choice, ast.Call) and isinstance(label, ast.Constant):
        for given in choice.keywords:
            if _is_number(given.value):
                full = f"{name}.{label.value}.{given.arg}"
                yield Constant(module, full, _shown(given.value), text)


def _is_number(node: ast.expr) -> bool:
    """Whether an expression is made of numbers only, and of functions of ``math`` and ``np``."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(_is_number, node.elts))
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    if isinstance(node, ast.Dict):
        return bool(node.values) and all(map(_is_number, node.values))
    if isinstance(node, ast.Call):
        return _of_library(node.func) and all(map(_is_number, node.args))
    return _of_library(node) and ast.unparse(node).startswith("math.")


def _of_library(node: ast.expr) -> bool:
    return (
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("math", "np")
    )


def _shown(node: ast.expr) -> str:
    if isinstance(node, ast.Tuple):
        inner = [_shown(x) for x in node.elts]
        return "; ".join(f"({x})" if ";" in x else x for x in inner)
    if isinstance(node, ast.Dict):
        return "; ".join(
            f"{ast.unparse(k).rpartition('.')[2].lower()} {_shown(v)}"
            for k, v in zip(node.keys, node.values, strict=True)
            if k is not None
        )
    text = ast.unparse(node)
    text = re.sub(r"np\.arange\((\d+)\)", lambda m: f"(0 … {int(m[1]) - 1})", text)
    for old, new in (("math.pi", "π"), ("np.", ""), (" ** ", "^"), (" * ", " · "), (" / ", "/")):
        text = text.replace(old, new)
    return text


def main() -> None:
    """Print the table, write the summary into a page, or print the count of other numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", type=Path, metavar="PAGE", help="page to put the summary into")
    parser.add_argument("--literals", action="store_true", help="count numbers inside functions")
    given = parser.parse_args()
    if given.literals:
        for module, count in literals().most_common():
            print(f"{count:5} {module}")
        print(f"{literals().total():5} in all")
    elif given.write is None:
        print(table())
    else:
        write_between(given.write, (START, END), summary())


if __name__ == "__main__":
    main()
