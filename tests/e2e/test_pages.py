"""README and pages: their commands, snippets, links and numbers hold."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import build_parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *DOCS]


def blocks(text: str, language: str) -> list[str]:
    """Fenced code of a language."""
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def marked(name: str) -> str:
    """The command that stands in the README under a marker."""
    (text,) = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)```", README, flags=re.DOTALL)
    return text.rstrip("\n")


def test_readme_commands() -> None:
    """Two commands, one line each; what they run is there."""
    job, tests = marked("main job"), marked("tests")
    assert "\n" not in job + tests
    assert job.startswith('python -m venv .venv && .venv/bin/pip install ".[mujoco]" && ')
    python, example, _ = job.rpartition("&& ")[2].split()
    assert python == ".venv/bin/python"
    assert (ROOT / example).is_file()
    for line in re.findall(r"^\$ capsense (.*?)(?:#.*)?$", README, flags=re.MULTILINE):
        build_parser().parse_args(line.split())
    assert tests == '.venv/bin/pip install ".[test]" && .venv/bin/python -m pytest -n 2'


def test_readme_snippets() -> None:
    """Python compiles and uses public names; the page is short."""
    for code in blocks(README, "python"):
        compile(code, "README.md", "exec")
        assert set(re.findall(r"\bcs\.(\w+)", code)) <= {*cs.__all__, "mujoco", "pybullet"}
    assert len(README.splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links(page: Path) -> None:
    """What a page links to, or shows, is there."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", text):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_pages_are_in_the_navigation() -> None:
    """Every page of docs/ is listed in mkdocs.yml."""
    listed = set(re.findall(r"- (\S+\.md)", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert listed == {p.relative_to(ROOT / "docs").as_posix() for p in DOCS}


def test_conventions_of_an_asymmetric_pose() -> None:
    """The numbers printed on the conventions page, for a pose without any symmetry."""
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    (code,) = blocks(page, "python")
    scope: dict[str, object] = {}
    exec(code, scope)
    pose = scope["pose"]
    assert isinstance(pose, cs.Pose)
    printed = [
        [float(v) for v in re.findall(r"-?\d+\.\d+", line.partition("# ")[2])]
        for line in code.splitlines()
        if "print(" in line
    ]
    assert printed[0] == approx(pose.quaternion, abs=5e-5)
    assert printed[1] == approx(pose.apply((1.0, 0.0, 0.0)), abs=5e-5)
    roll, pitch, yaw = np.radians((10, 20, 30))
    c, s = np.cos, np.sin
    rx = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    ry = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    rz = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    assert pose.rotation == approx(rz @ ry @ rx, abs=1e-12)
    assert pose.apply((0, 0, 0)) == approx((0.1, 0.2, 0.3))


def test_the_reference_names_what_is_there() -> None:
    """Every object of the API pages imports."""
    for page in (ROOT / "docs" / "api").glob("*.md"):
        for target in re.findall(r"^::: (\S+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            module, _, name = target.rpartition(".")
            there = hasattr(import_module(module), name) or find_spec(target) is not None
            assert there, (page.name, target)
