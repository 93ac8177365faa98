"""Normal vectors with a known covariance, which may be singular."""

import numpy as np
import pytest
import scipy.linalg
from scipy import stats

from msg_analysis.inference.statistics import direction_p, pseudo_inverse, quadratic_form

RANDOM = np.random.default_rng(1)
ROOT = RANDOM.standard_normal((3, 3))
COVARIANCE, V = ROOT @ ROOT.T, RANDOM.standard_normal(3)
# Entries in other units, one that depends on the others, and one that is always 0.
MIX = np.vstack([np.eye(3), [[1.0, 1.0, 0.0]], np.zeros((1, 3))]) * np.array([1, 1e6, 1e-3, 5, 1])[:, None]
MIXED = MIX @ COVARIANCE @ MIX.T


def test_quadratic_form_ignores_dependent_and_dead_entries():
    chi2, dof = quadratic_form(MIX @ V, MIXED)
    assert dof == 3
    assert chi2 == pytest.approx(V @ scipy.linalg.solve(COVARIANCE, V), rel=1e-8)


def test_pseudo_inverse_gives_the_same_quadratic_form():
    assert (MIX @ V) @ pseudo_inverse(MIXED) @ (MIX @ V) == pytest.approx(quadratic_form(MIX @ V, MIXED)[0], rel=1e-8)


def test_p_value_of_a_direction():
    direction = np.array([1.0, -2e-6, 3e3, 0.1, 7.0])
    seen = MIX.T @ direction
    deviation = np.sqrt(seen @ COVARIANCE @ seen)
    assert direction_p(direction, MIX @ V, MIXED) == pytest.approx(2 * stats.norm.sf(abs(seen @ V) / deviation))


def test_a_direction_without_variance_has_no_p_value():
    dependent = np.array([5.0, 5e-6, 0.0, -1.0, 0.0])
    assert direction_p(dependent, MIX @ V, MIXED) is None
    dead = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    assert direction_p(dead, MIX @ V, MIXED) is None
    rounding = np.diag([40.0, 1e-29, 1e-30])
    assert direction_p(np.array([0.0, 1.0, 1.0]), np.array([1.0, 1e-12, 0.0]), rounding) is None
