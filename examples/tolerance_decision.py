"""A tolerance study with a decision at the end: which tolerances of a sensor to tighten?

    python examples/tolerance_decision.py out/

The study ``tolerances/hand_pad.toml`` is carried out. From its samples the yields of tighter
tolerances follow by its linear fit. The cheapest choice that reaches the target is then carried out
as a study of its own, which confirms it or not. An interrupted run goes on where it stopped.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from capsense.studies import load_study, tolerance
from capsense.studies.tolerances import (
    Distribution,
    Tolerances,
    ToleranceStudy,
    Yield,
    narrowed,
    tornado,
)

STUDY = Path(__file__).parent / "tolerances" / "hand_pad.toml"
TARGET = 0.99
"""Part of the sensors that must pass."""
OPTIONS = {
    "spacers of ±0.2 mm": (0.30, "standoff", Distribution("uniform", 0.0048, 0.0052)),
    "covers of ±0.05 mm": (0.25, "cover", Distribution("uniform", 0.00195, 0.00205)),
    "gain calibrated to 0.2 %": (0.60, "gain", Distribution("uniform", 0.998, 1.002)),
}
"""What can be done: its cost for each sensor, the parameter, and how that scatters then."""

JOBS: int | None = None
"""Processes; None for one a processor, fewer where memory is short."""


def main(folder: Path, samples: int | None = None) -> bool:
    """Carry it out; whether the decision is confirmed.

    Args:
        folder: Where tables and the plot go.
        samples: Of each study; by default as many as its file says.
    """
    folder.mkdir(parents=True, exist_ok=True)
    study, evaluation = load_study(STUDY)
    study = replace(study, samples=samples or study.samples)
    found = tolerance(study, evaluation, folder / "today.csv", jobs=JOBS)
    tornado(found, ["dcode_E"]).savefig(folder / "tornado.png", dpi=150)
    print(f"today: {told(found.yields['all'])}")
    for name, share in found.outputs["dcode_E"].contributions.items():
        print(f"  {name:9s} {100 * share:5.1f} % of the variance")

    choice = cheapest(study, found)
    if choice is None:
        print(f"decision: no choice reaches {100 * TARGET:g} %; widen the specification")
        return False
    tighter = {OPTIONS[name][1]: OPTIONS[name][2] for name in choice}
    better = replace(study, parameters={**study.parameters, **tighter})
    checked = tolerance(better, evaluation, folder / "tightened.csv", jobs=JOBS).yields["all"]
    cost = sum(OPTIONS[name][0] for name in choice)
    print(f"check of {' and '.join(choice) or 'nothing'}: {told(checked)}")
    confirmed = checked.share >= TARGET
    verdict = "do it" if confirmed else "not confirmed, keep looking"
    print(f"decision: {' and '.join(choice) or 'nothing'} for {cost:.2f} a sensor: {verdict}")
    return confirmed


def cheapest(study: ToleranceStudy, found: Tolerances) -> tuple[str, ...] | None:
    """The cheapest choice of options whose yield by the linear fit reaches the target."""
    choices = [c for count in range(len(OPTIONS) + 1) for c in combinations(OPTIONS, count)]
    good = []
    for choice in choices:
        factors = {
            parameter: scatter.deviation / study.parameters[parameter].deviation
            for _, parameter, scatter in (OPTIONS[name] for name in choice)
        }
        expected = narrowed(found, study.specifications, factors)["all"]
        cost = sum(OPTIONS[name][0] for name in choice)
        print(f"{' and '.join(choice) or 'nothing'}, {cost:.2f}: {100 * expected.share:.1f} %")
        if expected.share >= TARGET:
            good.append((cost, choice))
    return min(good)[1] if good else None


def told(share: Yield) -> str:
    """A yield with its 95 % interval, as text."""
    ends = f"{100 * share.low:.1f} to {100 * share.high:.1f}"
    return f"{share.passed} of {share.samples} pass, {100 * share.share:.1f} % ({ends})"


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
