"""Files whose numbers are expressions of parameters, ``size = ["=side", "=side / 2"]``, or are set
by their dotted keys, ``electrode.E1.size.x``."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from capsense._validate import read_toml, shorten, suggest
from capsense.errors import CapSenseError, DesignError

Value = float | str
"""Of a parameter: a number, or the text of a key, such as a material."""
Point = Mapping[str, Value]
"""Values of the parameters by their names."""

_OPERATORS: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
}  # fmt: skip


AXES = {"x": 0, "y": 1, "z": 2}
"""What the first three entries of a list are also called in a dotted key."""
SWITCHES = {"true": True, "false": False}


@dataclass(frozen=True)
class Template:
    """A design, scenario or readout file that parameters change."""

    name: str
    """Name of the file, for messages."""
    content: Mapping[str, Any]
    """Nested tables and lists; texts that begin with ``=`` are expressions."""
    folder: Path
    """What the file names is relative to this folder."""
    error: type[CapSenseError] = DesignError
    """What is raised for anything that is wrong."""
    keys: tuple[str, ...] = ()
    """Parameters that are dotted keys of this file."""

    @classmethod
    def load(cls, path: str | Path, what: str, error: type[CapSenseError]) -> Template:
        """A file by its path; ``what`` it is, for messages.

        Raises:
            CapSenseError: An ``error``, if there is no such file, or it is not TOML.
        """
        file = Path(path)
        return cls(file.name, read_toml(file, what, error), file.resolve().parent, error)

    @cached_property
    def parameters(self) -> frozenset[str]:
        """Names that its expressions use, and its dotted keys."""
        return frozenset(names_in(self.content) | set(self.keys))

    def filled(self, point: Point) -> dict[str, Any]:
        """The file's content for values of the parameters.

        Raises:
            CapSenseError: An expression or a key is wrong.
        """
        try:
            out = fill(self.content, point)
            for key in self.keys:
                out = _put(out, key, key.split("."), point[key])
        except DesignError as error:
            raise self.error(f"{self.name}: {error}") from None
        return out


def _put(node: Any, key: str, parts: list[str], value: Value) -> Any:
    """A copy of tables and lists in which the entry that ``parts`` of a key name is ``value``."""
    part, rest = parts[0], parts[1:]
    if isinstance(node, list):
        where: Any = _place(node, key, part)
        old, out = node[where], list(node)
    elif isinstance(node, Mapping):
        where, old, out = part, node.get(part, {} if rest else None), dict(node)  # type: ignore[assignment]
    else:
        raise DesignError(f"{key}: {shorten(node)} has no part {part!r}; end the key before it")
    if rest:
        out[where] = _put(old, key, rest, value)
    elif isinstance(old, list | Mapping):
        inner = f"{key}.0" if isinstance(old, list) else f"{key}.{next(iter(old), 'KEY')}"
        raise DesignError(f"{key} is {shorten(old)}; name one of its entries, as in {inner}")
    else:
        out[where] = SWITCHES.get(value, value) if isinstance(value, str) else plain(value)
    return out


def _place(node: list[Any], key: str, part: str) -> int:
    """The entry of a list by its number from 0, as x, y or z, or by the name of a table."""
    names = [n.get("name") if isinstance(n, Mapping) else None for n in node]
    if part in names:
        return names.index(part)
    number = int(part) if part.isdecimal() else AXES.get(part, -1)
    if not 0 <= number < len(node):
        known = [n for n in names if isinstance(n, str)] or [str(k) for k in range(len(node))]
        raise DesignError(f"{key}: no entry {part!r}; {suggest(part, known)}")
    return number


def plain(number: float) -> float | int:
    """A whole number as an integer, which keys such as counts need."""
    return int(number) if abs(number) < 2**53 and float(number).is_integer() else float(number)


def fill(template: Mapping[str, Any], named: Point, digits: int | None = None) -> dict[str, Any]:
    """The content of a file for values of its parameters.

    Args:
        template: Nested tables and lists; texts that begin with ``=`` are expressions.
        named: Values of the parameters.
        digits: Decimals that results are rounded to; None for no rounding.

    Raises:
        DesignError: An expression is wrong.
    """

    def of(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: of(v) for k, v in value.items()}
        if isinstance(value, list):
            return [of(v) for v in value]
        if isinstance(value, str) and value.startswith("="):
            result = evaluate(value[1:], named)
            return plain(result if digits is None else round(result, digits))
        return value

    return {k: of(v) for k, v in template.items()}


def names_in(template: Any) -> set[str]:
    """Names of the parameters that a template's expressions use; of broken ones, none."""

    def texts(value: Any) -> Iterator[str]:
        if isinstance(value, Mapping):
            for part in value.values():
                yield from texts(part)
        elif isinstance(value, list):
            for part in value:
                yield from texts(part)
        elif isinstance(value, str) and value.startswith("="):
            yield value[1:].strip()

    out: set[str] = set()
    for text in texts(template):
        try:
            nodes = ast.walk(ast.parse(text, mode="eval"))
        except (SyntaxError, ValueError, RecursionError):
            continue  # evaluate() says what is wrong
        out |= {node.id for node in nodes if isinstance(node, ast.Name)}
    return out


def evaluate(text: str, named: Point) -> float:
    """The value of an expression of numbers, names, ``+ - * /`` and brackets.

    Raises:
        DesignError: It is something else, or names an unknown parameter.
    """

    def of(node: ast.AST) -> float:
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return float(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            if node.id not in named:
                raise DesignError(f"={text}: no parameter {node.id!r}; {suggest(node.id, named)}")
            value = named[node.id]
            if isinstance(value, str):
                raise DesignError(f"={text}: {node.id} is {value!r}; give numbers")
            return value
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            return -of(node.operand)
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](of(node.left), of(node.right))
        raise DesignError(f"={text} is more than numbers, parameters, + - * / and brackets")

    try:
        value = of(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ZeroDivisionError, ValueError, RecursionError) as error:
        raise DesignError(f"={text} cannot be worked out: {error}") from None
    if not math.isfinite(value):
        raise DesignError(f"={text} is {value}; give finite numbers")
    return value
