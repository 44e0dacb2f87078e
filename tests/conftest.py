"""Simulators that tests share: a background field is built once, not once a test."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # threads of several processes wait for one another
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import interpreted
import pytest
import tiny_field

import capsense as cs
from capsense.field.background import BackgroundField
from capsense.field.cache import load_or_build

if interpreted.ON:
    interpreted.start()

Simulators = Callable[..., "cs.Simulator"]


@pytest.fixture(scope="session")
def field_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where tests keep built fields: beside pytest's own cache, by the sources that build them.

    A field built by other sources is never read, and is removed. ``CAPSENSE_TEST_FIELDS`` names
    another folder, whose fields these sources have built: ``.ci/run`` has one.
    """
    if "CAPSENSE_TEST_FIELDS" in os.environ:
        return Path(os.environ["CAPSENSE_TEST_FIELDS"])
    package = Path(cs.__file__).parent
    digest = hashlib.sha256()
    for part in ("field", "design"):
        for path in sorted((package / part).rglob("*")):
            if path.suffix in (".py", ".toml", ".stl"):
                digest.update(path.name.encode() + path.read_bytes())
    cache = getattr(request.config, "cache", None)
    if cache is None:
        return tmp_path_factory.mktemp("fields")
    root = Path(cache.mkdir("capsense-fields"))
    mine = root / digest.hexdigest()[:16]
    for other in root.iterdir():
        if other != mine:
            shutil.rmtree(other, ignore_errors=True)
    mine.mkdir(exist_ok=True)
    return mine


@pytest.fixture(scope="session")
def simulators(field_cache: Path) -> Simulators:
    """``simulators(design, **options)``: a simulator at rest, the same one for the same call.

    It is reset, so that no test depends on the order of the others.
    """
    made: dict[tuple[object, ...], cs.Simulator] = {}

    def get(design: cs.Design | str, **options: object) -> cs.Simulator:
        name = design if isinstance(design, str) else design.content_hash()
        key = (name, *sorted((k, repr(v)) for k, v in options.items()))
        if key not in made:
            made[key] = cs.Simulator(design, cache_dir=field_cache, **options)
        made[key].reset()
        return made[key]

    return get


@pytest.fixture(scope="session")
def foam(field_cache: Path) -> tuple[cs.Design, BackgroundField]:
    """Two discs under a foam that gives way, and a rough field of it."""
    design = cs.load_design(_HERE / "data/foam.toml")
    with tiny_field.few_sources():
        return design, load_or_build(design, tiny_field.SETTINGS, cache_dir=field_cache)


@pytest.fixture
def foam_field(
    foam: tuple[cs.Design, BackgroundField], monkeypatch: pytest.MonkeyPatch
) -> cs.Design:
    """The design of :func:`foam`; whoever asks for its field meanwhile gets the rough one."""
    for module in ("capsense.fleet.fleet", "capsense.simulator"):
        monkeypatch.setattr(f"{module}.load_or_build", lambda *a, **b: foam[1])
    return foam[0]


@pytest.fixture
def broken_pipes_ignored() -> Iterator[None]:
    """For tests that start Gmsh themselves: it makes a broken pipe end the process."""
    yield
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)


_ORDER = ["unit", "physics", "e2e", "slow"]
"""Layers, which are the folders of this one, and the mark of long tests; a test may be marked with
a later one than its folder."""
_HERE = Path(__file__).parent


def _wanted(config: pytest.Config) -> list[str]:
    """Layers that a run may have tests of.

    Without a marker expression slow tests are left out, and of the whole suite or a whole layer
    the end-to-end tests as well, unless that layer is ``e2e``: ``pytest tests/e2e/cli`` runs all
    but slow ones.
    """
    asked = config.option.markexpr
    if asked in _ORDER[:3]:
        return [asked]
    if asked or any("::" in a for a in config.args):
        return _ORDER
    whole = {config.rootpath, _HERE, _HERE / "unit", _HERE / "physics"}
    return _ORDER[:2] if {config.rootpath / a for a in config.args} <= whole else _ORDER[:3]


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import nothing of folders that have only tests of later layers than are wanted."""
    if collection_path.parent == _HERE and collection_path.name in _ORDER:
        last = max(_ORDER.index(layer) for layer in _wanted(config))
        if _ORDER.index(collection_path.name) > last:
            return True
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give each test its layer, and leave out what was not asked for."""
    for item in items:
        own = [mark for mark in _ORDER if item.get_closest_marker(mark)]
        layer = item.path.relative_to(_HERE).parts[0]
        if layer not in _ORDER[:3]:
            raise pytest.UsageError(f"{item.path} is in no layer: move it to unit, physics or e2e")
        if not own:
            item.add_marker(layer)
        elif _ORDER.index(own[0]) < _ORDER.index(layer):
            raise pytest.UsageError(f"{item.nodeid} is marked {own[0]}, but its folder is {layer}")
    if config.option.markexpr:
        return
    left = set(_ORDER).difference(_wanted(config))
    out = [i for i in items if any(i.get_closest_marker(m) for m in left)]
    config.hook.pytest_deselected(items=out)
    items[:] = [i for i in items if i not in set(out)]
