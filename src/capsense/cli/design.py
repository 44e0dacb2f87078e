"""``capsense design``: what a design is made of, and what its field came out as."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli import (
    OK,
    PICTURES,
    TARGET_MISSED,
    BuildProgress,
    arg,
    check_picture,
    command,
    facts,
    field_figures,
    grouped,
    say,
    share,
    table,
)
from capsense.errors import DesignError

if TYPE_CHECKING:
    from capsense.design import Design, Surface
    from capsense.simulator import Simulator


@command(
    "design",
    "print a sensor design with its field's figures and baseline, or draw it",
    arg("design NAME|FILE", "a packaged design, or a design .toml", nargs="?"),
    arg("--list", "list the packaged designs"),
    arg(
        "-o --output PICTURE",
        f"draw the layout to this file ({', '.join(PICTURES)}); without it nothing is drawn",
        type=Path,
    ),
    arg("--no-build", "leave out the field's figures and the baseline"),
    arg(
        "--tolerance SHARE",
        "refine panels until each entry of the baseline is this accurate, such as 1%%; no field",
        type=share,
    ),
    arg("-q --quiet", "no progress bar"),
)
def design(args: argparse.Namespace) -> int:
    """Print what a sensor design is made of, the figures of its field, and its baseline: the
    capacitance matrix with nothing in front of it. The field is computed at a design's first
    use and kept in the user's cache; --no-build leaves it alone.

    examples:
      capsense design --list
      capsense design six_patch
      capsense design stripe --no-build -o stripe.png     draw it: top view and stack
      capsense design my/sensor.toml
      capsense design six_patch --tolerance 1%            the resolution that this asks for
    """

    if args.list:
        print(_listing())
        return OK
    if args.design is None:
        raise DesignError(
            "no design given; name a packaged one or a .toml file, or see capsense design --list"
        )
    if args.output is not None:
        check_picture("--output", args.output, DesignError)

    from capsense.design import load_design

    design = load_design(args.design)
    print(describe(design))
    if args.output is not None:
        from capsense.plotting.designs import draw_design

        draw_design(design).get_figure().savefig(args.output, dpi=150)  # type: ignore[union-attr]
        print(f"\ndrawn to {args.output}")
    else:
        design_file, picture = (shlex.quote(x) for x in (args.design, f"{design.name}.png"))
        print(f"\ndraw it with: capsense design {design_file} --no-build -o {picture}")
    if args.tolerance is not None:
        return _refined(design, args.tolerance, quiet=args.quiet)
    if not args.no_build:
        import capsense

        with BuildProgress(quiet=args.quiet) as progress:
            simulator = capsense.Simulator(design, progress=progress)
        print(f"\n{describe_field(simulator)}")
    return OK


def _refined(design: Design, tolerance: float, *, quiet: bool) -> int:
    """Print the resolution that meets a tolerance, capacitances and their estimated errors."""
    from capsense.field.refinement import refine

    def tell(stage: str) -> None:
        if not quiet and stage.endswith("panels"):
            say(stage)

    found = refine(design, tolerance, tell)
    names, own = design.electrode_names, design.resolution
    worst = f"{100 * found.errors.max():.2g} %"
    print()
    print(
        facts([
            ("tolerance", f"{100 * tolerance:g} %, {'met' if found.met else 'NOT met'}"),
            ("largest estimated error", worst),
            ("boundary panels", grouped(found.panels)),
            ("resolution", f"{found.resolution:.3g} under [build]; the design has {own:g}"),
        ])
    )  # fmt: skip
    for head, values, form in (
        ("baseline [pF]", 1e12 * found.capacitance, ".4f"),
        ("error [%]", 100 * found.errors, ".2g"),
    ):
        rows = [
            (name, *(format(value, form) for value in row))
            for name, row in zip(names, values, strict=True)
        ]
        print(f"\n{table((head, *names), rows)}")
    return OK if found.met else TARGET_MISSED


def _listing() -> str:
    from capsense.design import available_designs, load_design

    rows = []
    for name in available_designs():
        design = load_design(name)
        rows.append((name, str(len(design.electrodes)), design.description))
    return table(("name", "electrodes", "description"), rows)


def describe(design: Design) -> str:
    """What a design is made of, as text."""

    x, y, z = (1e3 * s for s in design.domain.size)
    walls = "open, from" if design.domain.open else "floor"
    head = [
        ("design", design.name),
        ("", design.description),
        ("domain", f"{x:g} × {y:g} × {z:g} mm, {walls} {design.domain.backplane * 1e3:g} mm below"),
        ("local ground", _ground(design)),
        ("hash", design.content_hash()[:16]),
    ]
    blocks = [
        facts([h for h in head if h[1]]),
        table(
            ("electrode", *_SPANS, "area [mm²]"),
            [(e.name, *_spans(e.surface), _area(e.surface)) for e in design.electrodes],
        ),
    ]
    if design.layers:
        rows = [
            (k.name, k.material, f"{k.eps_r:g}", *_spans(k.surface), str(len(k.surface.facets)))
            for k in design.layers
        ]
        blocks.append(table(("layer", "material", "eps_r", *_SPANS, "faces"), rows))
    if design.conductors:
        rows = [
            (c.name, c.role.value, *_spans(c.surface), _area(c.surface)) for c in design.conductors
        ]
        blocks.append(table(("conductor", "role", *_SPANS, "area [mm²]"), rows))
    return "\n\n".join(blocks)


def _ground(design: Design) -> str:
    """What the local ground is on; nothing where it is earth."""
    farads = design.ground_capacitance
    if farads is None:
        return ""
    return f"{1e12 * farads:g} pF to earth" if farads else "floats"


_SPANS = ("x [mm]", "y [mm]", "z [mm]")


def _span(low: float, high: float) -> str:
    low, high = round(low * 1e3, 4) + 0.0, round(high * 1e3, 4) + 0.0
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _spans(surface: Surface) -> list[str]:
    return [_span(low, high) for low, high in zip(*surface.bounds, strict=True)]


def _area(surface: Surface) -> str:
    return f"{surface.area * 1e6:.1f}"


def describe_field(simulator: Simulator) -> str:
    """Figures of the field and baseline matrix, as text."""
    import numpy as np

    from capsense.scene import Scene

    names = simulator.electrode_names
    figures = facts((str(key), grouped(value)) for key, value in field_figures(simulator).items())
    rows = [
        (name, *(f"{c * 1e12:.4f}" for c in row))
        for name, row in zip(names, simulator.baseline, strict=True)
    ]
    text = f"{figures}\n\n{table(('baseline [pF]', *names), rows)}"
    guarded = simulator.step(Scene()).self_capacitance
    if not np.allclose(guarded, simulator.baseline.diagonal(), rtol=1e-6, atol=0.0):
        head = "self, shields driven [pF]"
        text += f"\n\n{table((head, *names), [('', *(f'{c * 1e12:.4f}' for c in guarded))])}"
    return text
