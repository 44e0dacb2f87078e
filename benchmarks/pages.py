"""What stands between two markers of a page: read it, or replace it."""

from __future__ import annotations

from pathlib import Path

Markers = tuple[str, str]
"""Start and end."""


def between(page: str, markers: Markers) -> str:
    """The text between two markers of a page."""
    start = page.index(markers[0]) + len(markers[0])
    return page[start : page.index(markers[1], start)].strip()


def replaced(page: str, markers: Markers, text: str) -> str:
    """The page with other text between two markers."""
    start = page.index(markers[0]) + len(markers[0])
    end = page.index(markers[1], start)
    return f"{page[:start]}\n{text.strip()}\n{page[end:]}"


def write_between(path: Path, markers: Markers, text: str) -> None:
    """Replace what stands between two markers of a file.

    Raises:
        ValueError: The file does not have both.
    """
    page = path.read_text(encoding="utf-8")
    if markers[1] not in page.partition(markers[0])[2]:
        raise ValueError(f"{path} has no lines {markers[0]!r} and {markers[1]!r}; add them")
    path.write_text(replaced(page, markers, text), encoding="utf-8")
