"""Simulators that tests share: a background field is built once, not once a test."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import capsense as cs

Simulators = Callable[..., "cs.Simulator"]


@pytest.fixture(scope="session")
def field_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where tests keep built fields: beside pytest's own cache, by the sources that build them.

    A field built by other sources is never read, and is removed.
    """
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


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave slow tests out unless a marker expression or a single test asks for them."""
    if config.option.markexpr or any("::" in a for a in config.args):
        return
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="slow; run with -m slow"))
