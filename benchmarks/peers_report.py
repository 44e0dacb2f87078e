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
    return row["label"] not in ("capsense", "paper")


def report(results: dict[str, Any]) -> str:
    """The ratios as text."""
    out = ["", "ratios of medians, and of the largest errors over the gaps"]
    for group in ("30k", "100k", "same planes"):
        found = rows(results, group)
        own = found.pop("capsense", None)
        if own is None:
            continue
        out.append(f"  {group}: CapSense {own['median_ms']:.2f} ms, {100 * own['worst']:.1f} %, "
                   f"{own['tetrahedra']:,d} tetrahedra")  # fmt: skip
        for row in sorted(found.values(), key=lambda r: r["median_ms"]):
            time, error = (row[key] / own[key] for key in ("median_ms", "worst"))
            out.append(f"    {row['name']:36s} {time:7.1f} times the time, {error:5.1f} the error")
    everything = [r for group in results for r in rows(results, group).values()]
    good = [r for r in everything if r["worst"] <= GOOD]
    ours = min((r for r in good if r["label"] == "capsense"), key=_time, default=None)
    theirs = min((r for r in good if is_peer(r)), key=_time, default=None)
    out.append(f"  time to {100 * GOOD:g} % at all gaps")
    for title, row in (("CapSense", ours), ("best peer", theirs)):
        out.append(f"    {title}: none" if row is None else
                   f"    {title}: {row['name']}, {row['tetrahedra']:,d} tetrahedra, "
                   f"{row['median_ms']:.2f} ms, {100 * row['worst']:.1f} %")  # fmt: skip
    if ours and theirs:
        out.append(f"    ratio {theirs['median_ms'] / ours['median_ms']:.0f}")
    return "\n".join(out)


def _time(row: Row) -> float:
    return float(row["median_ms"])


STYLES = {
    "CapSense": ("o", "tab:orange"),
    "the paper's scheme": ("s", "black"),
    "MKL PARDISO": ("^", "tab:blue"),
    "MKL PARDISO, scikit-fem P2": ("v", "tab:cyan"),
    "CHOLMOD": ("<", "tab:purple"),
    "SciPy Jacobi-CG": ("D", "tab:gray"),
    "pyamg-CG": (">", "tab:brown"),
    "scikit-fem": ("P", "tab:pink"),
    "NGSolve": ("X", "tab:green"),
    "NGSolve, remeshed": ("*", "tab:olive"),
}


def plot(results: dict[str, Any], path: Path) -> None:
    """Draw the largest error over the gaps against the median step time, a line a method."""
    series: dict[str, list[Row]] = {}
    for group in results:
        for row in rows(results, group).values():
            if row["name"] in STYLES:
                series.setdefault(row["name"], []).append(row)
    figure, axes = plt.subplots(figsize=(8.0, 5.0), layout="constrained")
    for name, (marker, colour) in STYLES.items():
        found = sorted(series.get(name, []), key=lambda r: r["tetrahedra"])
        if found:
            axes.loglog([r["median_ms"] for r in found], [100 * r["worst"] for r in found],
                        marker=marker, color=colour, label=name, markersize=7,
                        linewidth=2.5 if name == "CapSense" else 1.0, zorder=3)  # fmt: skip
    axes.axhline(100 * GOOD, color="0.6", linewidth=0.8, linestyle="--", zorder=1)
    axes.annotate(f"{100 * GOOD:g} %", (0.995, 100 * GOOD), xycoords=("axes fraction", "data"),
                  ha="right", va="bottom", color="0.4")  # fmt: skip
    axes.set_xlabel("time of a step [ms], median, one core")
    axes.set_ylabel("largest error of ΔC$_{ii}$, gaps 5 to 100 mm [%]")
    axes.set_title("A moving bar over six electrodes, full 6 × 6 matrix", loc="left", fontsize=11)
    axes.grid(which="major", color="0.9")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=120)
    plt.close(figure)
