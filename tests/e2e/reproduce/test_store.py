"""Parts of a study: computed once, reused after an interruption, never from a damaged file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from capsense.reproduce.harness import Store


def test_resumes_after_an_interruption(tmp_path: Path) -> None:
    """Of ten units the four before the interruption are not computed again."""
    calls: list[int] = []

    def unit(k: int, stop: int) -> dict[str, np.ndarray]:
        if k == stop:
            raise KeyboardInterrupt
        calls.append(k)
        return {"square": np.array([k**2])}

    def study(store: Store, stop: int) -> list[int]:
        return [
            int(store.get("unit", {"k": k}, lambda k=k: unit(k, stop))["square"][0])
            for k in range(10)
        ]

    with pytest.raises(KeyboardInterrupt):
        study(Store(tmp_path), stop=4)
    store = Store(tmp_path)
    assert study(store, stop=-1) == [k**2 for k in range(10)]
    assert calls == list(range(10))
    assert (store.reused, store.computed) == (4, 6)


def test_any_input_makes_another_unit(tmp_path: Path) -> None:
    """Numbers, texts, arrays and nested ones; equal ones are found again."""
    inputs = [
        {"x": 1.0, "design": "a", "path": np.arange(3.0)},
        {"x": 1.0 + 1e-15, "design": "a", "path": np.arange(3.0)},
        {"x": 1.0, "design": "b", "path": np.arange(3.0)},
        {"x": 1.0, "design": "a", "path": np.array([0.0, 1.0, 2.0 + 1e-15])},
        {"x": 1.0, "design": "a", "path": np.arange(3)},
        {"x": 1.0, "design": "a", "path": {"legs": [np.float64(1.0), None]}},
    ]
    store = Store(tmp_path)
    for round_ in range(2):
        for k, one in enumerate(inputs):
            assert store.get("u", one, lambda k=k: {"k": k})["k"] == k
        assert (store.computed, store.reused) == (6, 6 * round_)


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[:100],
        lambda whole: b"",
        lambda whole: whole[:60] + bytes(20) + whole[80:],  # inflate fails
        lambda whole: whole.replace(b"PK\x01\x02", b"PK\x01\x03"),
    ],
)
def test_a_damaged_part_is_computed_again(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    """A file cut short or with wrong bytes is replaced; no half-written one takes its name."""
    Store(tmp_path).get("u", {}, lambda: {"a": np.arange(1000)})
    (part,) = (tmp_path / "parts").iterdir()
    part.write_bytes(damage(part.read_bytes()))
    store = Store(tmp_path)
    np.testing.assert_array_equal(store.get("u", {}, lambda: {"a": [7]})["a"], [7])
    assert store.computed == 1
    assert list((tmp_path / "parts").iterdir()) == [part]


def test_unknown_inputs_are_refused(tmp_path: Path) -> None:
    """An object whose state is not seen would make a wrong key."""
    with pytest.raises(TypeError, match="set"):
        Store(tmp_path).get("u", {"x": {1, 2}}, lambda: {})
