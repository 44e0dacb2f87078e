"""Layouts of boards from CAD: copper of each net, stack-up and outline, made into a design.

One reader per format yields a :class:`BoardLayout`; :func:`capsense.layout.convert.convert` makes a
design of it.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from capsense._validate import as_number
from capsense.errors import LayoutError
from capsense.layout.board import BoardLayout

READERS = {
    ".kicad_pcb": "kicad",
    ".gbrjob": "gerber",
    ".gbr": "gerber",
    ".ger": "gerber",
    ".gtl": "gerber",
    ".gbl": "gerber",
    ".zip": "gerber",
    ".dxf": "dxf",
    ".svg": "svg",
    ".step": "step",
    ".stp": "step",
}
"""Module of this package that reads a file with this ending; folders are told by what they hold."""


def load_layout(
    path: str | Path, *, tolerance: float = 2e-5, thickness: float = 1.6e-3
) -> BoardLayout:
    """Read the layout of a board.

    Args:
        path: A ``.kicad_pcb``, ``.dxf``, ``.svg`` or ``.step`` file; a folder or ``.zip`` of Gerber
            files, or one of them; or a folder with one ``.stl`` file per net, in millimetres.
        tolerance: Largest deviation of the chords that replace arcs [m].
        thickness: Thickness of the board [m], where the file does not state it.

    Returns:
        The layout; lengths in metres, in the axes of the board (y up, z = 0 at the outer face of
        the top copper).

    Raises:
        LayoutError: The file is missing, damaged or of a kind that is not read, or holds no copper.
        MissingDependencyError: The library that reads the format is not installed.
    """
    for name, value in (("tolerance", tolerance), ("thickness", thickness)):
        if not 1e-7 <= as_number(value) <= 0.1:
            raise LayoutError(f"{name} = {value!r}; give a length from 1e-7 to 0.1 m")
    if not isinstance(path, str | os.PathLike):
        raise LayoutError(f"the layout is of {type(path).__name__}; give a path")
    path = Path(path)
    if not path.exists():
        raise LayoutError(f"there is no layout {path}; check the path")
    reader = READERS.get(path.suffix.lower()) if path.is_file() else _reader_of_folder(path)
    if reader is None:
        raise LayoutError(
            f"{path} is of no kind that is read; give one of {', '.join(READERS)}, a folder of "
            "Gerber files, or a folder with one .stl file per net"
        )
    layout = import_module(f"capsense.layout.{reader}").read(path, tolerance * 1e3, thickness * 1e3)
    if not layout.nets:
        raise LayoutError(f"{path} holds no copper; check that its layers are those of the board")
    return layout


def _reader_of_folder(path: Path) -> str | None:
    endings = {file.suffix.lower() for file in path.iterdir()}
    boards = sorted(path.glob("*.kicad_pcb"))
    if boards:
        raise LayoutError(f"{path} is a folder; give the board in it, {boards[0].name}")
    if ".stl" in endings:
        return "stl"
    from capsense.layout.gerber import is_set

    return "gerber" if is_set(path) else None
