"""Simulators that tests share: a background field is built once, not once a test."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
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


LAYERS = {
    "unit": "design humans unit mesh plotting readout scene solver field/test_panels.py "
    "field/test_grid.py test_constants_page.py test_jit.py test_public_api.py test_reading.py "
    "test_scenario.py test_shared.py test_simd.py test_thread_pool.py",
    "physics": "",  # all that is not named
    "e2e": "adapters benchmarks cli learning recording reproduce server unity viewer "
    "field/test_cache.py field/test_shipped.py fleet/test_autograd.py "
    "fleet/test_genesis.py fleet/test_isaac_lab.py fleet/test_mjlab.py "
    "fleet/test_parallel_simulators.py mesh/test_gmsh_mesher.py solver/test_soft_gap.py "
    "test_assistive_gym_patch.py "
    "test_contributing.py test_copies.py test_damaged.py test_examples.py test_from_the_paper.py "
    "test_project.py "
    "test_kernel_cache.py test_pages.py test_simulator_estimate.py test_simulator_examples.py "
    "test_troubleshooting.py test_tutorials.py test_validation_page.py",
}
"""Folders and files of each layer; a mark moves a single test to a later one."""
_PLACES = {place: layer for layer, places in LAYERS.items() for place in places.split()}
_ORDER = [*LAYERS, "slow"]
_HERE = Path(__file__).parent


def _layer(path: Path) -> str:
    place = path.relative_to(_HERE)
    return _PLACES.get(place.as_posix()) or _PLACES.get(place.parts[0]) or "physics"


def _wanted(config: pytest.Config) -> list[str]:
    """Layers that a run may have tests of.

    Without a marker expression slow tests are left out, and of the whole suite the end-to-end tests
    as well: ``pytest tests/cli`` runs all but slow ones.
    """
    asked = config.option.markexpr
    if asked in LAYERS:
        return [asked]
    if asked or any("::" in a for a in config.args):
        return _ORDER
    whole = [config.rootpath / a for a in config.args] in ([_HERE], [config.rootpath])
    return ["unit", "physics"] if whole else list(LAYERS)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file that has only tests of later layers than those that are wanted."""
    if collection_path.name.startswith("test_"):
        last = max(_ORDER.index(layer) for layer in _wanted(config))
        if _ORDER.index(_layer(collection_path)) > last:
            return True
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give each test its layer, and leave out what was not asked for."""
    for item in items:
        own = [mark for mark in _ORDER if item.get_closest_marker(mark)]
        layer = _layer(item.path)
        if not own:
            item.add_marker(layer)
        elif _ORDER.index(own[0]) < _ORDER.index(layer):
            raise pytest.UsageError(f"{item.nodeid} is marked {own[0]}, but its file is {layer}")
    if config.option.markexpr:
        return
    left = set(_ORDER).difference(_wanted(config))
    out = [i for i in items if any(i.get_closest_marker(m) for m in left)]
    config.hook.pytest_deselected(items=out)
    items[:] = [i for i in items if i not in set(out)]
