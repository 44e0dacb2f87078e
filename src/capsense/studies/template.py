"""Design files whose numbers are expressions of parameters: ``size = ["=side", "=side / 2"]``."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from capsense._validate import suggest
from capsense.errors import DesignError

_OPERATORS: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
}  # fmt: skip


def fill(
    template: Mapping[str, Any], named: Mapping[str, float], digits: int | None = None
) -> dict[str, Any]:
    """The content of a design file for values of its parameters.

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
            return result if digits is None else round(result, digits)
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


def evaluate(text: str, named: Mapping[str, float]) -> float:
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
            return named[node.id]
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
        raise DesignError(f"={text} is {value}; lengths are finite")
    return value
