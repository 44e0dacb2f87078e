"""Run notebooks without Jupyter, and store their outputs: texts and figures of each code cell.

    python examples/notebooks/run.py                        # all of this folder
    python examples/notebooks/run.py first_sensor.ipynb

The documentation shows them, and a test runs them and compares what they print.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import matplotlib as mpl

HERE = Path(__file__).resolve().parent


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """The cells of a notebook that hold code."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(notebook: dict[str, Any]) -> dict[str, Any]:
    """Execute the code cells in one namespace and put their outputs into the notebook.

    Returns:
        The names that the cells define.
    """
    mpl.use("agg")
    import matplotlib.pyplot as plt

    scope: dict[str, Any] = {"__name__": "notebook"}
    for number, cell in enumerate(code_cells(notebook), start=1):
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), scope)
        cell["execution_count"] = number
        cell["outputs"] = []
        if text := printed.getvalue():
            lines = text.splitlines(keepends=True)
            cell["outputs"].append({"name": "stdout", "output_type": "stream", "text": lines})
        for figure in map(plt.figure, plt.get_fignums()):
            picture = io.BytesIO()
            figure.savefig(picture, format="png", dpi=100, metadata={"Software": None})
            cell["outputs"].append(
                {
                    "data": {"image/png": base64.b64encode(picture.getvalue()).decode()},
                    "metadata": {},
                    "output_type": "display_data",
                }
            )
        plt.close("all")
    return scope


def main() -> None:
    """Run what is named, or all, and write the files again."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NOTEBOOK", help="default all of the folder")
    names = parser.parse_args().names or sorted(path.name for path in HERE.glob("*.ipynb"))
    for name in names:
        path = HERE / name
        notebook = json.loads(path.read_text(encoding="utf-8"))
        run(notebook)
        text = json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True)
        path.write_text(text + "\n", encoding="utf-8")
        print(f"{name}: {len(code_cells(notebook))} cells")


if __name__ == "__main__":
    main()
