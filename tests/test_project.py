"""What the project's own files say agrees: package data, workflows, changelog, support levels."""

from __future__ import annotations

import ast
import re
import runpy
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CLASSIFIERS = PROJECT["project"]["classifiers"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def row(page: str, start: str) -> list[str]:
    """The cells of a row of a table."""
    (line,) = re.findall(rf"^\| {re.escape(start)} \|.*$", page, flags=re.MULTILINE)
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_classifiers_are_what_the_page_says_is_tested() -> None:
    page = read("docs/platforms.md")
    tested = row(page, "Linux, x86-64")
    (heads,) = re.findall(r"^\| \| (Python .*) \|$", page, flags=re.MULTILINE)
    versions = [
        version
        for head, cell in zip(heads.split("|"), tested[1:], strict=True)
        if cell == "all tests run"
        for version in re.findall(r"3\.\d+", head)
    ]
    claimed = [c.rpartition(" ")[2] for c in CLASSIFIERS if re.search(r":: 3\.\d+$", c)]
    assert versions == claimed
    assert [c for c in CLASSIFIERS if c.startswith("Operating System")] == [
        "Operating System :: POSIX :: Linux"
    ]
    assert ("Typing :: Typed" in CLASSIFIERS) == (ROOT / "src/capsense/py.typed").is_file()


def test_numba_is_of_the_versions_that_were_tried() -> None:
    (spec,) = (d for d in PROJECT["project"]["dependencies"] if d.startswith("numba"))
    pattern = r"^_PARTS = \(0, (\d+)\), \(0, (\d+)\)$"
    ((first, last),) = re.findall(pattern, read("src/capsense/_jit.py"), flags=re.MULTILINE)
    assert spec == f"numba>=0.{first},<0.{int(last) + 1}"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.name)
def test_workflows(path: Path) -> None:
    """Jobs that never ran are marked, may fail, and are those that the page names."""
    text = path.read_text(encoding="utf-8")
    assert "NEVER RUN" in text
    assert "permissions:\n  contents: read\n" in text
    for line in text.splitlines():
        if re.search(r"\{ os: (macos|windows)|python: \"3\.14\"", line):
            assert "unproven: true }  # never run" in line
    for named in re.findall(r"(?:tests|examples|\.github)/[\w./-]+\.py", text):
        assert (ROOT / named).is_file(), named


def test_every_package_is_core_or_not() -> None:
    """A new package must be put on one side of the contract that keeps the core apart."""
    (contract,) = (
        c
        for c in PROJECT["tool"]["importlinter"]["contracts"]
        if c["name"].startswith("the core imports neither")
    )
    sides = [*contract["source_modules"], *contract["forbidden_modules"]]
    there = {
        f"capsense.{path.stem}"
        for path in (ROOT / "src" / "capsense").iterdir()
        if (path.suffix == ".py" and path.stem[0] != "_") or (path / "__init__.py").is_file()
    }
    outside = {"capsense.bench", "capsense.mesh"}  # a command; Gmsh, which is an extra
    assert there - outside <= set(sides)


def test_no_module_imports_what_imports_it() -> None:
    """Imports in functions and for type checkers count; those of a package's own name do not."""
    source = ROOT / "src"
    files = {
        ".".join(path.relative_to(source).with_suffix("").parts).removesuffix(".__init__"): path
        for path in (source / "capsense").rglob("*.py")
    }

    def imported(path: Path) -> set[str]:
        out = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                out |= {name.name for name in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path} has a relative import; write the full name"
                names = {f"{node.module}.{name.name}" for name in node.names}
                out |= {name if name in files else str(node.module) for name in names}
        return out & files.keys()

    graph = {module: imported(path) for module, path in files.items()}
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"modules import each other: {' <- '.join(error.args[1])}")


def test_changelog_has_sections_for_users() -> None:
    text = read("CHANGELOG.md")
    section = text[text.index("## [Unreleased]") : text.index("## [1.0.0]")]
    heads = re.findall(r"^### (\w+)", section, flags=re.MULTILINE)
    assert heads
    assert set(heads) <= {"Added", "Changed", "Fixed", "Removed", "Deprecated", "Security"}


def test_a_release_needs_the_same_version_everywhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script, version = str(ROOT / ".github/check_version.py"), PROJECT["project"]["version"]
    monkeypatch.setattr(sys, "argv", [script, f"v{version}", "--notes"])
    runpy.run_path(script, run_name="__main__")
    notes = capsys.readouterr().out
    assert "\n- " in notes
    assert "\n## " not in notes
    monkeypatch.setattr(sys, "argv", [script, "v0.0.1"])
    with pytest.raises(SystemExit, match=rf"tag is v0\.0\.1, but .* tag v{re.escape(version)}"):
        runpy.run_path(script, run_name="__main__")


def test_experimental_parts_say_so() -> None:
    """Pages of parts that the table of support levels calls experimental begin with it."""
    rows = re.findall(r"^\| (.*) \| experimental \|", read("docs/support.md"), flags=re.MULTILINE)
    assert len(rows) >= 5
    for target in {link for line in rows for link in re.findall(r"\((\w+\.md)", line)}:
        page = read(f"docs/{target}")
        assert "support.md" in page, target
        assert "xperimental" in page, target
