import numpy as np
import pytest
from scipy import stats

from msg_analysis.inference.statistics import batch_interval


def test_is_students_interval_of_the_batch_means():
    series = np.random.default_rng(1).standard_normal(1007)
    means = [series[7 + 50 * b : 57 + 50 * b].mean() for b in range(20)]
    expected = stats.t.interval(0.95, 19, loc=np.mean(means), scale=stats.sem(means))
    assert batch_interval(series) == pytest.approx(expected)


def test_too_short():
    assert batch_interval(np.zeros(39)) is None
