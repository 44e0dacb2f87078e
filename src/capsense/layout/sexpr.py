"""S-expressions, the nested lists that files of KiCad consist of."""

from __future__ import annotations

import re
from collections.abc import Iterator

Node = list["str | Node"]

_TOKEN = re.compile(r'\s*(?:([()])|"((?:[^"\\]|\\.)*)"|([^\s()"]+))')


def parse(text: str) -> Node:
    """The nested lists of an S-expression.

    Raises:
        ValueError: Brackets do not match.
    """
    stack: list[Node] = [[]]
    for match in _TOKEN.finditer(text):
        bracket, quoted, word = match.groups()
        if bracket == "(":
            stack.append([])
        elif bracket == ")":
            if len(stack) == 1:
                raise ValueError("a bracket closes that was not opened")
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(word if quoted is None else re.sub(r"\\(.)", r"\1", quoted))
    if len(stack) != 1 or len(stack[0]) != 1 or not isinstance(stack[0][0], list):
        raise ValueError("brackets do not match; the file is cut off")
    return stack[0][0]


def children(node: Node, *names: str) -> Iterator[Node]:
    """The lists in a node that begin with one of the names."""
    for item in node:
        if isinstance(item, list) and item and item[0] in names:
            yield item


def child(node: Node, name: str) -> Node:
    """The first list in a node that begins with a name; an empty one if there is none."""
    return next(children(node, name), [])


def words(node: Node) -> list[str]:
    """The words of a list after its name."""
    return [item for item in node[1:] if isinstance(item, str)]


def numbers(node: Node) -> list[float]:
    """The numbers of a list after its name."""
    out = []
    for word in words(node):
        try:
            out.append(float(word))
        except ValueError:
            continue
    return out


def number(node: Node, name: str, default: float = 0.0) -> float:
    """The number that stands in a named list of a node."""
    return next(iter(numbers(child(node, name))), default)


def word(node: Node, name: str, default: str = "") -> str:
    """The word that stands in a named list of a node."""
    return next(iter(words(child(node, name))), default)
