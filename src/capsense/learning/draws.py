"""Random values in the files of data sets: how they are written, drawn, and put into columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.random import Generator

from capsense.scenario import ScenarioTable

Drawn = dict[str, Any]
"""What was drawn, by column."""
PREFIX = "drawn."
"""Begins the names of columns of what was drawn."""


class Draw:
    """Decides what is random in tables of a file, and keeps what it decides.

    Args:
        rng: Random numbers.
    """

    def __init__(self, rng: Generator) -> None:
        self.rng = rng
        self.drawn: Drawn = {}
        """What was decided, by the names that :func:`columns_of` has."""

    def table(self, raw: Mapping[str, Any], table: ScenarioTable, path: str) -> dict[str, Any]:
        """A table with everything random in it decided.

        Args:
            raw: The table, as it stands in the file.
            table: Says in errors where it stands.
            path: The beginning of the columns' names.

        Raises:
            ScenarioError: What should be random is written wrongly.
        """
        return {key: self.value(value, table, f"{path}.{key}") for key, value in raw.items()}

    def value(self, value: Any, table: ScenarioTable, path: str) -> Any:
        """A value with everything random in it decided; see :meth:`table`."""
        if isinstance(value, list):
            return [self.value(v, table, f"{path}.{k}") for k, v in enumerate(value)]
        if not isinstance(value, Mapping):
            return value
        if "any" in value:
            options = _options(value, table)
            number = int(self.rng.integers(len(options)))
            name, kind = _choice(options, path)
            self.drawn[PREFIX + name] = number if kind is int else kind(options[number])
            return self.value(options[number], table, _path_of(options[number], number, path))
        if "from" in value or "to" in value:
            span = ScenarioTable(value, table.source, f"{table.item}: {{ from, to }}")
            self.drawn[PREFIX + path] = found = _number(span, self.rng)
            return found
        out = self.table(value, table, path)
        if out.get("quaternion") == "uniform":
            four = self.rng.standard_normal(4)
            turn = (four / np.linalg.norm(four)).tolist()
            out["quaternion"] = self.drawn[f"{PREFIX}{path}.quaternion"] = turn
        return out

    def happens(self, chance: float, path: str) -> bool:
        """Whether something of a probability does; noted where that is not certain."""
        found = bool(self.rng.random() < chance)
        if chance < 1:
            self.drawn[PREFIX + path] = found
        return found


def columns_of(value: Any, table: ScenarioTable, path: str) -> Iterator[tuple[str, type]]:
    """Columns of what is random in a value: names, and what is in them.

    That is ``float``, ``int`` for the number of an option, ``str`` or ``bool`` for one that is
    such, or ``list`` for a quaternion.

    Raises:
        ScenarioError: What should be random is written wrongly.
    """
    if isinstance(value, list):
        for k, item in enumerate(value):
            yield from columns_of(item, table, f"{path}.{k}")
    if not isinstance(value, Mapping):
        return
    if "any" in value:
        options = _options(value, table)
        name, kind = _choice(options, path)
        yield PREFIX + name, kind
        for number, option in enumerate(options):
            yield from columns_of(option, table, _path_of(option, number, path))
    elif "from" in value or "to" in value:
        yield PREFIX + path, float
    else:
        for key, item in value.items():
            yield from columns_of(item, table, f"{path}.{key}")
        if value.get("quaternion") == "uniform":
            yield f"{PREFIX}{path}.quaternion", list


def alternatives(value: Any) -> list[Any]:
    """All that a value which may be ``{ any = […] }`` can become."""
    if isinstance(value, Mapping) and isinstance(value.get("any"), list):
        return [item for option in value["any"] for item in alternatives(option)]
    return [value]


def _options(value: Mapping[str, Any], table: ScenarioTable) -> list[Any]:
    options = value["any"]
    if len(value) > 1 or not isinstance(options, list) or not options:
        raise table.error(f"{dict(value)} must be {{ any = [one, another, …] }}")
    return options


def _choice(options: list[Any], path: str) -> tuple[str, type]:
    """The column of which option is taken: itself, if all are texts or numbers, or its number."""
    for kind, given in ((bool, (bool,)), (str, (str,)), (float, (int, float))):
        if all(isinstance(o, given) and (kind is bool or type(o) is not bool) for o in options):
            return path, kind
    return f"{path}.any", int


def _path_of(option: Any, number: int, path: str) -> str:
    """Where an option notes what is random in it: a choice of its own not where this one does."""
    nested = isinstance(option, Mapping) and "any" in option
    return f"{path}.any.{number}" if nested else path


def _number(span: ScenarioTable, rng: Generator) -> float:
    """A number between two; with ``log`` uniform in its logarithm, with ``steps`` one of so many.

    Steps suit sizes: a body of new proportions takes the solver many times as long as others.
    """
    span.only(("from", "to", "log", "steps"))
    log = span.boolean("log", False)
    low = span.number("from", 1e-300 if log else -1e12, 1e12)
    high = span.number("to", low, 1e12)
    steps = span.integer("steps", 2, 10**6, 0)
    share = rng.integers(steps) / (steps - 1) if steps else rng.random()
    return float(low * (high / low) ** share if log else low + (high - low) * share)
