"""Refuse a release whose tag is not what the files say: ``check_version.py v1.2.3 [--notes]``.

``--notes`` prints the version's section of the changelog.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def text(name: str) -> str:
    """A file of the repository."""
    return (ROOT / name).read_text(encoding="utf-8")


def notes_of(version: str) -> str | None:
    """The section of a version in the changelog, without its heading."""
    found = re.search(
        rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d\n(.*?)(?=^## \[|\Z)",
        text("CHANGELOG.md"),
        flags=re.MULTILINE | re.DOTALL,
    )
    return found[1].strip() if found else None


def main(tag: str, *options: str) -> str:
    """What to print.

    Raises:
        SystemExit: A file has another version than the tag, or the changelog has no section.
    """
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    cited = re.search(r"^version: (\S+)$", text("CITATION.cff"), flags=re.MULTILINE)
    notes = notes_of(version)
    faults = []
    if tag != f"v{version}":
        faults.append(f"the tag is {tag}, but pyproject.toml has {version}; tag v{version}")
    if cited is None or cited[1] != version:
        faults.append(f"CITATION.cff has no line 'version: {version}'; correct it")
    if not notes:
        faults.append(f"CHANGELOG.md has no section '## [{version}] - DATE'; write one")
    if faults:
        sys.exit("\n".join(faults))
    return str(notes) if "--notes" in options else f"version {version}, as the tag says"


if __name__ == "__main__":
    sys.stdout.write(main(*sys.argv[1:]) + "\n")
