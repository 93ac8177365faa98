"""Thinning: lowest and highest value of each interval of steps, next to a slow computation in full."""

from __future__ import annotations

import numpy as np
import pytest

from msg_analysis.common import arrays
from msg_analysis.report import plot_style
from msg_analysis.report.plot_style import envelope, thin, thin_together


@pytest.fixture
def states() -> np.ndarray:
    return np.random.default_rng(3).standard_normal((103, 4, 3))


@pytest.mark.parametrize("block", [1, 100, 10**6])  # numbers that are looked at together
def test_bins(states: np.ndarray, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot_style, "BLOCK_NUMBERS", block)
    found = thin(states, 1, None, numbers=100)
    assert found.width == 9  # 2 * 103 * 4 / 100, rounded up
    values = states[:, :, 1]
    apart = values - values.mean(axis=1, keepdims=True)
    for pair, series in (
        (found.values, values),
        (found.deviations, apart),
        (found.centre, values.mean(axis=1, keepdims=True)),
        (found.error, (apart**2).sum(axis=1, keepdims=True)),
    ):
        parts = [series[first : first + 9] for first in range(0, 103, 9)]
        assert np.allclose(pair[0], [part.min(axis=0) for part in parts])
        assert np.allclose(pair[1], [part.max(axis=0) for part in parts])
    low, high = envelope(found.values)
    assert np.allclose(low, [values[first : first + 9].min() for first in range(0, 103, 9)])
    assert np.allclose(high, [values[first : first + 9].max() for first in range(0, 103, 9)])


@pytest.mark.parametrize("block", [100, 10**6])
@pytest.mark.parametrize("numbers", [100, 10**4])
def test_several_replicas(states: np.ndarray, block: int, numbers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each as if it were thinned alone."""
    monkeypatch.setattr(plot_style, "BLOCK_NUMBERS", block)
    together = thin_together(states, slice(1, 3), 0.25, numbers)
    for found, replica in zip(together, (1, 2), strict=True):
        alone = thin(states, replica, 0.25, numbers)
        assert found.width == alone.width
        for name in ("values", "deviations", "centre", "error"):
            for one, other in zip(getattr(found, name), getattr(alone, name), strict=True):
                np.testing.assert_array_equal(one, other)


def test_short_runs_are_kept_whole(states: np.ndarray) -> None:
    found = thin(states, 0, 0.5)
    assert found.width == 1
    assert found.values[0] is found.values[1]
    assert np.allclose(found.values[0], states[:, :, 0])
    assert np.allclose(found.error[0][:, 0], ((states[:, :, 0] - 0.5) ** 2).sum(axis=1))


def test_gaps_and_huge_numbers(states: np.ndarray) -> None:
    states[20:30, 2] = np.nan
    states[0, 0] = 1e300
    found = thin(states, 0, None, numbers=100)
    assert np.isnan(found.values[0][:, 2]).nonzero()[0].tolist() == []  # no bin is without a value: 18-26, 27-35
    states[18:27, 2] = np.nan
    assert np.isnan(thin(states, 0, None, numbers=100).values[0][:, 2]).nonzero()[0].tolist() == [2]
    assert np.isfinite(found.values[1][0, 0])
    assert np.isfinite(found.error[1][0, 0])


def test_a_run_of_any_length_has_one_size() -> None:
    for steps in (30_000, 300_000):
        found = thin(np.zeros((steps, 5, 1), np.float32), 0, None)
        assert found.values[0].size + found.values[1].size <= plot_style.NUMBERS + 10
    assert arrays.BLOCK_NUMBERS == plot_style.BLOCK_NUMBERS
