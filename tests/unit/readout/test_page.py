"""The readout's page: its snippets run, its files parse, its numbers hold."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

from capsense.readout.channels import ChannelBank, Pattern
from capsense.readout.config import parse_readout
from capsense.readout.laws import ShuntFrontEnd

PAGE = (Path(__file__).parents[3] / "docs" / "readout.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def test_python_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """All snippets, one after another, and the numbers that stand beside them."""
    scope: dict[str, object] = {}
    for number, code in enumerate(blocks("python")):
        exec(compile(code, f"docs/readout.md, snippet {number}", "exec"), scope)
    assert scope["muscle"].eps_r == approx(1836, abs=1)  # type: ignore[attr-defined]
    assert scope["muscle"].sigma == approx(0.503, abs=5e-4)  # type: ignore[attr-defined]
    assert scope["cold"].eps_r == approx(86, abs=0.5)  # type: ignore[attr-defined]
    assert scope["person"] == approx(97e-12, abs=0.5e-12)
    assert abs(scope["brightest"][:2]).max() <= 0.0151  # type: ignore[index]
    assert scope["J"].shape == (21, 2240)  # type: ignore[attr-defined]


def test_values_of_patterns() -> None:
    """The table of measurements: each pattern that is shown gives the value that is shown."""
    rng = np.random.default_rng(0)
    c = -rng.random((6, 6))
    c = c + c.T
    np.fill_diagonal(c, 1.0 - c.sum(axis=1) + np.diag(c))
    digits = {d: str(k) for k, d in enumerate("₁₂₃₄₅₆")}
    table = PAGE.partition("| measurement | pattern | value |\n")[2].partition("\n\n")[0]
    checked = 0
    for row in table.splitlines()[1:]:
        _, _, shown, value, _ = (cell.strip() for cell in row.split("|"))
        for text in re.findall(r"`(Pattern\(.*?\))`", shown):
            pattern = eval(text, {"Pattern": Pattern})
            found = ChannelBank([pattern], [f"E{k}" for k in range(1, 7)]).values(c)[0]
            if value:
                formula = re.sub(r"Σⱼ C(.)ⱼ", lambda m: f"c[{digits[m[1]]}].sum()", value)
                formula = (
                    re.sub(
                        r"C([₁-₆])([₁-₆])", lambda m: f"c[{digits[m[1]]},{digits[m[2]]}]", formula
                    )
                    .replace("²", "**2")
                    .replace("−", "-")
                )
                formula = re.sub(r"(\d|\]) c", r"\1*c", formula)
                assert found == approx(eval(formula, {"c": c}), rel=1e-12), text
                checked += 1
    assert checked == 9


def test_files_parse() -> None:
    for text in blocks("toml"):
        readout = parse_readout(tomllib.loads(text), [f"E{k}" for k in range(1, 7)])
        assert len(readout.bank) >= 1


def test_error_of_the_recovery_formula() -> None:
    """0.6 % for 1 pF and 1 kΩ at 1 MHz."""
    front_end = ShuntFrontEnd(1e6, 1e3)
    excess = front_end.recover(abs(front_end.output(1e-12))) / 1e-12 - 1
    assert excess == approx(6e-3, abs=5e-4)
