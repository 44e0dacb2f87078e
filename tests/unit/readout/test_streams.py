"""Random numbers by key and count, and distributions of figures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from capsense.readout.randomisation import Distribution, ReadoutRandomisation
from capsense.readout.streams import GAMMA, Streams, drawn, mixed, normal, root, uniform


def test_bits_are_those_of_splitmix():
    """Reference: the first outputs of SplitMix64 from seed 0, as published with it."""
    state = np.arange(1, 4, dtype=np.uint64) * np.uint64(GAMMA)
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert mixed(state).tolist() == expected


def test_numbers_are_even_and_normal():
    """Measured: Kolmogorov–Smirnov, and correlations along keys, counts and columns."""
    keys = drawn(root(5), np.arange(200))
    words = drawn(keys[:, None, None], np.arange(50)[:, None] * 256 + np.arange(8))
    assert stats.kstest(uniform(words).ravel(), "uniform").pvalue > 1e-3
    numbers = normal(words.reshape(-1, 8), 16)
    assert stats.kstest(numbers.ravel(), "norm").pvalue > 1e-3
    table = numbers.reshape(200, 50, 16)
    for one, other in (
        (table[1:], table[:-1]), (table[:, 1:], table[:, :-1]), (table[..., 1:], table[..., :-1]),
        (table[..., ::2], table[..., 1::2]),
    ):  # fmt: skip
        assert abs(np.mean(one * other)) < 4 / np.sqrt(one.size)
        assert abs(np.mean(one**2 * other**2) - 1) < 40 / np.sqrt(one.size)
    assert len(np.unique(words)) == words.size


def test_a_stream_depends_on_channel_and_sample_alone():
    """Invariant: in any order and any company."""
    keys, scale = drawn(root(1), np.arange(12)), np.linspace(0.0, 2.0, 12)
    stream = Streams(keys, scale, 3, 2, 1)
    channel, sample = np.arange(12), np.arange(12) + 5
    stream.at(channel, sample)
    whole, phases = stream.standard_normal((12, 5)), stream.random(4)
    order = np.random.default_rng(0).permutation(12)[:7]
    stream.at(channel[order], sample[order])
    np.testing.assert_array_equal(stream.standard_normal((7, 5)), whole[order])
    np.testing.assert_array_equal(stream.standard_normal(7), whole[order, 0])
    assert (whole[0] == 0).all()
    assert ((phases > 0) & (phases < 1)).all()
    other = Streams(keys, scale, 3, 2, 0)
    other.at(channel, sample)
    assert (other.standard_normal((12, 5))[1:] != whole[1:]).all()


@pytest.mark.parametrize(
    ("given", "truth"),
    [
        (Distribution("normal", 2.0, 0.5), stats.norm(2.0, 0.5)),
        (Distribution("uniform", -1.0, 3.0), stats.uniform(-1.0, 4.0)),
        (Distribution("triangular", 1.0, 5.0, 2.0), stats.triang(0.25, 1.0, 4.0)),
        (Distribution("triangular", 1.0, 5.0, 5.0), stats.triang(1.0, 1.0, 4.0)),
    ],
)
def test_distributions(given, truth):
    """Differential: quantiles and deviations of SciPy; draws follow them."""
    shares = np.linspace(1e-6, 1 - 1e-6, 101)
    np.testing.assert_allclose(given.values(shares), truth.ppf(shares), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(given.deviation, truth.std(), rtol=1e-12)
    keys = drawn(drawn(root(3), np.arange(50))[:, None], np.arange(2))
    figures = ReadoutRandomisation(gain=given, delay=given).draw(keys, np.arange(50), (50, 2, 6, 4))
    assert stats.kstest(figures["gain"].ravel(), truth.cdf).pvalue > 1e-3
    assert (figures["delay"] >= 0).all()
    assert (np.ptp(figures["delay"], axis=-1) == 0).all()
    assert figures["dead"].shape == (50, 2, 4)
    assert not figures["dead"].any()
    assert ReadoutRandomisation(gain=given).most("gain") >= figures["gain"].max()
