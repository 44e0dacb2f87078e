"""Hooks of MkDocs: notebooks in pages, and the changelog as a page.

``<!-- notebook: NAME -->`` becomes ``examples/notebooks/NAME.ipynb``: code, stored texts and stored
figures, headings one level lower, and the file for download. Links of ``CHANGELOG.md`` are from the
root of the repository, those of its page from ``docs``.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "examples" / "notebooks"
CHANGELOG = Path(__file__).parents[1] / "CHANGELOG.md"
MARKER = re.compile(r"<!-- notebook: (\w+) -->")


def markdown(name: str) -> str:
    """A notebook as Markdown."""
    parts = []
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            parts.append(f"```python\n{source}\n```")
            parts += [_shown(output) for output in cell["outputs"]]
        else:
            parts.append(re.sub(r"^#", "##", source, flags=re.MULTILINE))
    parts.insert(1, f"[Download the notebook](notebooks/{name}.ipynb){{ download }}")
    return "\n\n".join(parts)


def _shown(output: dict[str, Any]) -> str:
    if output["output_type"] == "stream":
        return "```text\n" + "".join(output["text"]).rstrip("\n") + "\n```"
    picture = output["data"]["image/png"].strip()
    return f'<img alt="Figure that the cell above draws" src="data:image/png;base64,{picture}">'


def on_files(files: Any, config: Any) -> Any:
    """Add the notebooks to the site."""
    from mkdocs.structure.files import File

    for path in sorted(FOLDER.glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown_text: str, /, page: Any, **_: Any) -> str:
    """Put notebooks, and the changelog, into a page."""
    if page.file.src_uri == "release_notes.md":
        return CHANGELOG.read_text(encoding="utf-8").replace("](docs/", "](")
    return MARKER.sub(lambda found: markdown(found[1]), markdown_text)
