"""Lines of code of each package: ``python benchmarks/sizes.py [--write PAGE] [--before REVISION]``.

Blank lines, comments and docstrings do not count. ``--write`` replaces the table between the two
markers of a page; ``--before`` adds a column for an earlier revision of the repository.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tarfile
import tokenize
from collections import defaultdict
from pathlib import Path

from headline_tables import table as markdown_table
from pages import write_between

ROOT = Path(__file__).parents[1]
SOURCE = Path("src/capsense")
MARKERS = ("<!-- sizes -->", "<!-- end of sizes -->")
_SILENT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENCODING, tokenize.ENDMARKER,
}  # fmt: skip


def code_lines(text: str) -> int:
    """Lines that hold code: no blank lines, comments, or strings that stand alone."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _SILENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return len(lines)


def sizes(files: dict[Path, str]) -> dict[str, tuple[int, int]]:
    """Package, or "." for single modules → modules, lines of code."""
    found: dict[str, list[int]] = defaultdict(list)
    for path, text in files.items():
        inner = path.relative_to(SOURCE).parts
        found[inner[0] if len(inner) > 1 else "."].append(code_lines(text))
    return {name: (len(counts), sum(counts)) for name, counts in found.items()}


def present() -> dict[Path, str]:
    """The sources of the working tree."""
    paths = sorted((ROOT / SOURCE).rglob("*.py"))
    return {path.relative_to(ROOT): path.read_text(encoding="utf-8") for path in paths}


def revision(name: str) -> dict[Path, str]:
    """The sources of a revision."""
    packed = subprocess.run(
        ["git", "-C", str(ROOT), "archive", name, str(SOURCE)], capture_output=True, check=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        return {
            Path(member.name): archive.extractfile(member).read().decode()  # type: ignore[union-attr]
            for member in archive
            if member.name.endswith(".py")
        }


def purpose(package: str) -> str:
    """The first sentence of a package's docstring."""
    if package == ".":
        return "`Simulator`, `Skin`, `Reading`, errors, and what all packages share"
    text = (ROOT / SOURCE / package / "__init__.py").read_text(encoding="utf-8")
    first = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    return re.sub(r":\w+:", "", first).rstrip(".").replace("``", "`")


def table(now: dict[str, tuple[int, int]], before: dict[str, tuple[int, int]] | None) -> str:
    """The table in Markdown."""
    columns = ["package", "lines of code", *(["before"] if before else []), "purpose"]
    rows = []
    for name in sorted({*now, *(before or {})}, key=lambda n: (n == ".", n)):
        modules, lines = now.get(name, (0, 0))
        old = [f"{before.get(name, (0, 0))[1]:,}"] if before else []
        label = "single modules" if name == "." else f"`{name}`"
        rows.append([label, f"{lines:,}", *old, purpose(name) if modules else "gone"])
    total = sum(lines for _, lines in now.values())
    old = [f"{sum(lines for _, lines in before.values()):,}"] if before else []
    rows.append(["**all**", f"{total:,}", *old, ""])
    return markdown_table(columns, rows)


def main() -> None:
    """Print the table, or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", type=Path, metavar="PAGE")
    parser.add_argument("--before", metavar="REVISION")
    options = parser.parse_args()
    text = table(sizes(present()), sizes(revision(options.before)) if options.before else None)
    if options.write is None:
        print(text)
        return
    write_between(options.write, MARKERS, text)


if __name__ == "__main__":
    main()
