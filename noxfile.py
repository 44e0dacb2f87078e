"""Sessions for nox, each in an environment of its own: ``nox -l`` lists them.

    nox -s lint                       # style, types, import rules
    nox -s tests                      # unit and physics, on the Python that runs nox
    nox -s tests-3.13 -- -m unit      # on another, with arguments for pytest
    nox -s tests_oldest               # the oldest dependencies that pyproject.toml admits

``nox --no-venv -s lint`` runs a session in the environment at hand and installs nothing.
"""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

import nox

nox.needs_version = ">=2024.4"
nox.options.sessions = ["lint", "docs"]
nox.options.reuse_existing_virtualenvs = True

PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
TEST_TOOLS = "pytest>=8", "pytest-xdist>=3.5", "hypothesis>=6.100"
BOUNDS = "tests/unit/solver/test_panel_kernels.py", "tests/unit/field/test_bem_kernels.py"


def install(session: nox.Session, *what: str) -> None:
    """Install packages, but not into an environment that was there before."""
    if session.venv_backend != "none":
        session.install(*what)


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """Unit and physics tests with all optional packages; arguments go to pytest."""
    install(session, "-e", ".[test]")
    session.run("python", "-m", "pytest", "-n", "2", *session.posargs)


@nox.session(python="3.11")
def tests_oldest(session: nox.Session) -> None:
    """Unit tests with the oldest versions of the dependencies of the core."""
    install(session, "uv")
    target = ("--python", f"{session.virtualenv.location}/bin/python")
    session.run("uv", "pip", "install", *target, "--resolution", "lowest-direct", "-e", ".")
    session.run("uv", "pip", "install", *target, *TEST_TOOLS)
    session.run("python", "-m", "pytest", "-n", "2", "-m", "unit", *session.posargs)


@nox.session
def lint(session: nox.Session) -> None:
    """Style, types and import rules."""
    install(session, "-e", ".[dev]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports")


@nox.session
def docs(session: nox.Session) -> None:
    """The pages, as a site in ``site/``; a warning is an error."""
    install(session, "-e", ".[docs]")
    session.run("mkdocs", "build", "--strict", env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session
def bench(session: nox.Session) -> None:
    """The asv benchmarks, once each, on the code at hand; arguments go to ``asv run``."""
    install(session, "-e", ".", "asv>=0.6.4")
    session.run("asv", "machine", "--yes")
    arguments = session.posargs or ["--quick", "--show-stderr", "--dry-run"]
    session.run("asv", "run", "--environment", "existing:python", *arguments)


@nox.session
def bounds(session: nox.Session) -> None:
    """Kernels that check every index, compiled apart from the others."""
    install(session, "-e", ".", *TEST_TOOLS)
    env = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": session.create_tmp()}
    session.run("python", "examples/five_lines.py", env=env)
    session.run("python", "-m", "pytest", *BOUNDS, *session.posargs, env=env)


@nox.session
def coverage(session: nox.Session) -> None:
    """Lines that the unit tests run; kernels count where Python runs them itself."""
    install(session, "-e", ".[test]", "coverage>=7.10")
    session.run("coverage", "erase")
    run = ("coverage", "run", "-m", "pytest")
    session.run(*run, "-m", "unit", *session.posargs)
    table = tomllib.loads(Path("benchmarks/mutations.toml").read_text(encoding="utf-8"))
    kernels = [entry for entry in table["module"].values() if entry.get("interpreted")]
    for tests_of_kernels in dict.fromkeys(entry["tests"] for entry in kernels):
        session.run(*run, *shlex.split(tests_of_kernels), env={"NUMBA_DISABLE_JIT": "1"})
    session.run("coverage", "combine")
    session.run("coverage", "report")
