"""Quantiles in passes over pieces, against numpy's of all numbers at once."""

from __future__ import annotations

import numpy as np
import pytest

from msg_analysis.common.arrays import AnyArray
from msg_analysis.inference import timing
from msg_analysis.inference.timing import extent, quantiles

RANDOM = np.random.default_rng(3)
NUMBERS = {
    "normal": RANDOM.normal(size=5_000),
    "integers": RANDOM.integers(0, 3, 5_000),
    "one far away": np.append(RANDOM.exponential(1e-6, 4_999), 1e9),
    "two values": np.repeat([0.25, 0.75], [4_000, 1_000]),
    "all alike": np.full(5_000, -7.5),
    "three": np.array([3.0, 1.0, 2.0]),
    "one": np.array([4]),
    "few large integers": RANDOM.integers(2**52, 2**52 + 40, 5_000),
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("at_once", [1, 100, 10_000])
def test_as_of_all_at_once(name: str, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "AT_ONCE", at_once)
    monkeypatch.setattr(timing, "BINS", 16)
    numbers, shares = NUMBERS[name], (0.0, 0.01, 0.5, 0.95, 0.99, 1.0)

    def pieces() -> list[AnyArray]:
        return np.array_split(numbers, 7)  # some are empty

    assert extent(pieces) == (numbers.size, numbers.min(), numbers.max())
    assert quantiles(pieces, shares) == np.quantile(numbers, shares).tolist()


def test_no_numbers() -> None:
    assert extent(lambda: [np.empty(0)]) == (0, np.inf, -np.inf)
    assert quantiles(lambda: [np.empty(0)], (0.5, 1.0)) == []
