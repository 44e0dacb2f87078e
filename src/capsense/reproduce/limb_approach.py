"""One electrode comes down onto a forearm: counts against distance, and how steeply they fall."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np

from capsense.reproduce.harness import Cell, Outcome, Report, ReportTable, Row, Store, judged, notes
from capsense.reproduce.limb_curves import (
    ARM,
    BACKINGS,
    BOX,
    BOXES,
    CHECK,
    EDGES,
    FAR,
    FITS,
    GROUNDINGS,
    MAIN,
    RADII,
    RANGES,
    SIZES,
    WITHIN,
    ArmFit,
    LimbCurves,
    LimbSetup,
    counts,
    distances,
    fit_arm,
    plot_approach,
    read_curves,
    slopes,
    zero_distance,
)


def run(folder: Path, *, reduced: bool, report: Report) -> Outcome:
    """Carry the study out; see :class:`capsense.reproduce.harness.Study`."""
    store = Store(folder)
    box = 1.0 if reduced else BOX
    setups = [LimbSetup(s, b, box) for s, b in product(SIZES[:1] if reduced else SIZES, BACKINGS)]
    boxes = [LimbSetup(box=e, backing=b) for b, e in product(BACKINGS, BOXES)]
    if reduced:
        boxes = [LimbSetup(box=e) for e in (0.5, 1.0)]
    todo = list(dict.fromkeys([*setups, *boxes, CHECK]))
    curves = {}
    for k, setup in enumerate(todo):
        report(f"{setup.size * 1e3:.0f} mm electrode in a box of {setup.box:g} m", k / len(todo))
        radii = RADII if setup in setups and not reduced else (MAIN,)
        names = tuple(GROUNDINGS) if setup in setups else ("grounded",)
        curves[setup] = read_curves(store, setup, radii, names, 3 if reduced else 6)
    fits = {} if reduced else _fits(store, report)
    report("done", 1.0)
    cases = {setup: curves[setup] for setup in setups}
    in_boxes = {setup: curves[setup] for setup in boxes}
    first = curves[LimbSetup(box=box)]
    return Outcome(
        "Limb approach: one electrode above a forearm",
        (*_rows(first, cases, in_boxes, curves[CHECK]), *_arm_rows(fits)),
        _tables(first, cases, in_boxes) | ({"human_arm": _arm_table(fits)} if fits else {}),
        {"limb_approach": plot_approach(cases, in_boxes)},
        notes("limb_approach"),
        store.told(),
    )


def _rows(
    first: LimbCurves,
    cases: dict[LimbSetup, LimbCurves],
    boxes: dict[LimbSetup, LimbCurves],
    fine: LimbCurves,
) -> list[Row]:
    hardware = np.array([_fit_slopes(*fit) for fit in FITS.values()])
    rows = []
    for n, value in enumerate(slopes(first.distance, first.change())):
        low, high = np.nanmin(hardware[:, n]), np.nanmax(hardware[:, n])
        span = f"{high:.2f} to {low:.2f}" if high - low > 0.005 else f"{low:.2f}"
        rows.append(Row(f"slope {_range(n)}, 30 mm free, tared", value, "", f"{span} (hardware)"))
    zeros = [1e2 * k / b for k, b in FITS.values()]
    rows.append(
        Row(
            "distance at which the fit k/d − b is zero, 30 mm free, tared",
            1e2 * zero_distance(first.distance, first.change()), "cm",
            f"{min(zeros):.1f} to {max(zeros):.1f} (hardware)",
        )
    )  # fmt: skip
    for setup, found in boxes.items():
        value = slopes(found.distance, found.change(tared=False))[-1]
        what = f"slope {_range(3)}, limb away, {setup.backing}, box {setup.box:g} m"
        rows.append(Row(what, value))
    rising = sum(int((np.diff(c.value) >= 0).any(axis=-1).sum()) for c in cases.values())
    rows.append(judged("curves that rise anywhere with distance", rising, below=1))
    pair = [
        np.array(slopes(c.distance, c.change(tared=False)))
        for c in (fine, boxes[LimbSetup(box=CHECK.box)])
    ]
    rows.append(
        judged(
            "slopes on the default mesh against this one, largest difference",
            float(np.abs(pair[0] - pair[1]).max()), below=0.1, source="our own",
        )
    )  # fmt: skip
    return rows


def _fits(store: Store, report: Report) -> dict[str, ArmFit]:
    """Of a person on 100 pF above either backing."""
    found = {}
    for backing in BACKINGS:
        report(f"fit to a human arm, {backing}", 0.9)
        curves = [
            read_curves(store, LimbSetup(e, backing), (MAIN,), ("100 pF",), 6, FAR) for e in EDGES
        ]
        change = np.array([c.change(MAIN, "100 pF", tared=False) for c in curves])
        found[backing] = fit_arm(EDGES, curves[0].distance, change)
    return found


def _arm_rows(fits: dict[str, ArmFit]) -> list[Row]:
    """The best of the fits is judged, the others stand beside it."""
    best = min(fits, key=lambda name: fits[name].apart, default="")
    rows = []
    for name, fit in fits.items():
        what = f"human arm, {name}: largest difference of the four slopes, three figures fitted"
        own = judged(what, fit.apart, below=WITHIN, source="our aim")
        rows.append(own if name == best else Row(what, fit.apart))
    return rows


def _arm_table(fits: dict[str, ArmFit]) -> ReportTable:
    """Slopes and fitted figures, and the figures' ranges."""
    units = (1e3, 1e3, 1e2)
    rows: list[tuple[Cell, ...]] = [("human arm", *_cells(list(ARM)), "", "", "")]
    for name, fit in fits.items():
        figures = tuple(f"{u * v:.0f}" for u, v in zip(units, fit.figures, strict=True))
        rows.append((name, *_cells(list(fit.slopes)), *figures))
        spans = [
            f"{u * a:.0f} to {u * b:.0f}" for u, (a, b) in zip(units, fit.ranges, strict=False)
        ]
        rows.append((f"{name}: all within {WITHIN}", "", "", "", "", *(spans or ["nowhere"] * 3)))
    names = ("edge [mm]", "offset [mm]", "tare [% of the reading at 15 cm]")
    return ReportTable(("behind the electrode", *HEADINGS, *names), tuple(rows))


def _fit_slopes(k: float, b: float) -> list[float]:
    z = distances(6)
    return slopes(z, k / z - b)


def _range(n: int) -> str:
    low, high = RANGES[n]
    return f"{low * 1e2:.0f}–{high * 1e2:.0f} cm"


HEADINGS = tuple(f"slope {_range(n)}" for n in range(len(RANGES)))


def _tables(
    first: LimbCurves, cases: dict[LimbSetup, LimbCurves], boxes: dict[LimbSetup, LimbCurves]
) -> dict[str, ReportTable]:
    slope_rows: list[tuple[Cell, ...]] = []
    curve_rows: list[tuple[Cell, ...]] = []
    for setup, found in cases.items():
        for radius, name in product(found.radii, found.groundings):
            change = found.change(radius, name)
            case = (1e3 * setup.size, setup.backing, 1e3 * radius, name)
            slope_rows.append((*case, *_cells(slopes(found.distance, change))))
            code = counts(*found.readings(radius, name))
            curve_rows += [
                (*case, float(1e3 * d), float(1e15 * c), float(n))
                for d, c, n in zip(found.distance, change, code, strict=True)
            ]
    case_names = ("electrode [mm]", "behind it", "limb radius [mm]", "limb")
    box_rows = [
        (setup.box, setup.backing, "retreat" if tared else "limb away",
         *_cells(slopes(c.distance, c.change(tared=tared))))
        for setup, c in boxes.items() for tared in (False, True)
        if setup.box >= 1.0 or not tared  # in the smallest, the retreat is outside
    ]  # fmt: skip
    sensors: list[tuple[Cell, ...]] = [
        (name, *_cells(_fit_slopes(*f)), 1e2 * f[0] / f[1]) for name, f in FITS.items()
    ]
    ours = _cells(slopes(first.distance, first.change()))
    zero = 1e2 * zero_distance(first.distance, first.change())
    main = [row for row in slope_rows if row[2] == 1e3 * MAIN]
    return {
        "slopes": ReportTable((*case_names, *HEADINGS), tuple(main)),
        "hardware": ReportTable(
            ("sensor", *HEADINGS, "zero [cm]"), (*sensors, ("simulated, 30 mm free", *ours, zero))
        ),
        "boxes": ReportTable(("box [m]", "behind it", "tare", *HEADINGS), tuple(box_rows)),
        "slopes_all": ReportTable((*case_names, *HEADINGS), tuple(slope_rows)),
        "curves": ReportTable(
            (*case_names, "distance [mm]", "change [fF]", "counts"), tuple(curve_rows)
        ),
    }


def _cells(values: list[float]) -> tuple[str, ...]:
    """Slopes as text; a dash where the tared reading is not positive throughout."""
    return tuple("–" if np.isnan(v) else f"{v:.2f}" for v in values)
