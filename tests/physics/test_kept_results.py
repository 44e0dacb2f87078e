"""Results stay what they were, but for rounding: ``tests/helpers/kept_cases.py`` tells of what."""

from __future__ import annotations

import json

import kept_cases
import numpy as np
import pytest

KEPT = json.loads(kept_cases.FILE.read_text(encoding="utf-8"))


def test_all_groups_are_kept():
    assert list(KEPT) == list(kept_cases.groups())


SLOW = "masked", "fields"
"""Groups that are worked out within a minute or more."""


@pytest.mark.parametrize(
    "group", [pytest.param(g, marks=pytest.mark.e2e) if g in SLOW else g for g in KEPT]
)
def test_results_are_kept(group, simulators):
    found, kept = kept_cases.groups()[group](simulators), KEPT[group]
    assert {case: list(row) for case, row in found.items()} == {
        case: list(row) for case, row in kept.items()
    }
    for case, row in kept.items():
        for name, values in row.items():
            largest = np.abs(values).max(initial=0.0)
            np.testing.assert_allclose(
                found[case][name], values, rtol=0, atol=kept_cases.SLACK.get(name, 1e-5) * largest,
                err_msg=f"{group}, {case}: {name}",
            )  # fmt: skip
