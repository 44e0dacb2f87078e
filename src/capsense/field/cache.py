"""Built background fields on disk, found by the content of the design and the settings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import platformdirs

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.background import (
    FORMAT,
    BackgroundField,
    BuildSettings,
    build_background,
    load_background,
    save_background,
)


def cache_key(design: Design, settings: BuildSettings) -> str:
    """Hash of everything a background field depends on."""
    text = f"{FORMAT}|{design.content_hash()}|{sorted(asdict(settings).items())!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def default_cache_dir() -> Path:
    """The user's cache directory, or ``CAPSENSE_CACHE_DIR``."""
    return Path(os.environ.get("CAPSENSE_CACHE_DIR") or platformdirs.user_cache_dir("capsense"))


def default_settings(design: Design) -> BuildSettings:
    """Settings that a design's ``[build]`` table asks for."""
    base = BuildSettings()
    factor = float(design.build.get("resolution", 1.0))
    return BuildSettings(base.lattice.refined(factor), base.panel_scale, base.calibration)


def load_or_build(
    design: Design,
    settings: BuildSettings | None = None,
    *,
    cache_dir: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> BackgroundField:
    """Return a design's background field, from the cache if it is there."""
    settings = settings or default_settings(design)
    folder = cache_dir or default_cache_dir()
    path = folder / f"{cache_key(design, settings)}.npz"
    if path.exists():
        try:
            return load_background(path)
        except FieldError:
            path.unlink(missing_ok=True)
    field = build_background(design, settings, progress)
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    save_background(field, part)
    os.replace(part, path)
    return field
