"""Ratios and the frontier plot from what ``peers.py`` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

GOOD = 0.03
"""Error of ΔC that counts as right."""
Row = dict[str, Any]


def rows(results: dict[str, Any], group: str) -> dict[str, Row]:
    """Results of a group by label, those of missing packages left out."""
    found = results.get(group, {"results": []})["results"]
    return {row["label"]: row for row in found if "missing" not in row}


def is_peer(row: Row) -> bool:
    """An off-the-shelf solver."""
    return row["label"] not in ("capsense", "paper", "paper, warm")


def report(results: dict[str, Any]) -> str:
    """The ratios as text."""
    out = ["", "ratios of medians, and of the largest errors over the gaps"]
    for group in ("30k", "100k", "same planes"):
        found = rows(results, group)
        own = found.pop("capsense", None)
        if own is None:
            continue
        out.append(f"  {group}: CapSense {own['median_ms']:.2f} ms, {100 * own['worst']:.1f} %")
        for row in sorted(found.values(), key=lambda r: r["median_ms"]):
            time, error = (row[key] / own[key] for key in ("median_ms", "worst"))
            out.append(f"    {row['name']:36s} {time:7.1f} times the time, {error:5.1f} the error")
    out.append(f"  time to {100 * GOOD:g} % at all gaps")
    return "\n".join([*out, *_time_to_good(results)])


def _time_to_good(results: dict[str, Any]) -> list[str]:
    """The fastest peer that is good enough, and CapSense in the same group."""
    good = [
        (row, group)
        for group in results
        for row in rows(results, group).values()
        if is_peer(row) and row["worst"] <= GOOD
    ]
    if not good:
        return ["    no peer comes so near"]
    theirs, group = min(good, key=lambda found: found[0]["median_ms"])
    both = [theirs, rows(results, group).get("capsense")]
    out = [
        f"    {row['name']}, {size_label(row)}, {row['median_ms']:.2f} ms, "
        f"{100 * row['worst']:.1f} %"
        for row in both
        if row is not None
    ]
    if both[1] is not None and both[1]["worst"] <= GOOD:
        out.append(f"    ratio {theirs['median_ms'] / both[1]['median_ms']:.0f}")
    return out


STYLES = {
    "CapSense": ("o", "#D55E00"),
    "the paper's scheme": ("s", "black"),
    "the paper's scheme, warm start": ("s", "0.6"),
    "SciPy Jacobi-CG": ("D", "#56B4E9"),
    "NGSolve": ("X", "#009E73"),
    "scikit-fem": ("P", "#CC79A7"),
    "MKL PARDISO": ("^", "#0072B2"),
    "CHOLMOD": ("<", "#7A5C00"),
    "pyamg-CG": (">", "#E69F00"),
    "MKL PARDISO, scikit-fem P2": ("v", "0.55"),
    "NGSolve, remeshed": ("*", "#009E73"),
}
"""Marker and colour of each method that is drawn, in the order of the legend."""
SIZED = {"CapSense": (7, 5), "SciPy Jacobi-CG": (-8, -14)}
"""Methods whose points tell their mesh, and where from the point [points]."""


def plot(results: dict[str, Any], path: Path) -> None:
    """Draw the largest error over the gaps against the median step time, a line a method."""
    series: dict[str, dict[tuple[int, str], Row]] = {}
    for group in results:
        for row in rows(results, group).values():
            if row["name"] in STYLES:
                series.setdefault(row["name"], {}).setdefault(point_key(row), row)
    plt.style.use("capsense.plotting.capsense")
    figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    for name, (marker, colour) in STYLES.items():
        found = [row for _, row in sorted(series.get(name, {}).items())]
        if name == "CapSense":
            found.sort(key=lambda r: r["median_ms"])
        if not found:
            continue
        x, y = [r["median_ms"] for r in found], [100 * r["worst"] for r in found]
        axes.loglog(x, y, marker=marker, color=colour, label=name,
                    markersize=11 if marker == "*" else 7, linewidth=1.2 + (name == "CapSense"),
                    zorder=4 if name == "CapSense" else 3)  # fmt: skip
        for row, a, b in zip(found if name in SIZED else [], x, y, strict=False):
            axes.annotate(size_label(row), (a, b), SIZED[name],
                          textcoords="offset points", fontsize=8, color=colour)  # fmt: skip
    axes.axhline(100 * GOOD, color="0.6", linewidth=0.8, linestyle="--", zorder=1)
    axes.annotate(f"{100 * GOOD:g} %", (0.995, 100 * GOOD), xycoords=("axes fraction", "data"),
                  ha="right", va="bottom", fontsize=8, color="0.4")  # fmt: skip
    axes.set_xlabel("time of a step, median, one core [ms]")
    axes.set_ylabel("largest error of ΔC$_{ii}$, gaps 5 to 100 mm [%]")
    axes.set_title("A bar moves over six electrodes. Small: tetrahedra, or preset")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    figure.savefig(path)
    plt.close(figure)


def point_key(row: Row) -> tuple[int, str]:
    """What tells the points of a method from each other: its mesh, or CapSense's preset."""
    return row["tetrahedra"], "" if row["tetrahedra"] else row["settings"]


def size_label(row: Row) -> str:
    """A number of tetrahedra in thousands or millions, or CapSense's preset."""
    count = row["tetrahedra"]
    if not count:
        return str(row["settings"].rpartition(" ")[2])
    return f"{count / 1e6:.1f} M" if count >= 0.95e6 else f"{count / 1e3:.0f} k"
