"""The matrix exponential against one of 40 digits, and against itself on another processor."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import mpmath
import numpy as np
import pytest
import scipy.linalg
from processors import another_processor

from msg_analysis.arithmetic.reproducible import exponential, reproducible_product


def laplacian(agents: int, scale: float, seed: int) -> np.ndarray:
    """Of a random graph, with a leader."""
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.exponential(scale, (agents, agents)) * (rng.random((agents, agents)) < 0.5), 1)
    adjacency = upper + upper.T
    result = np.diag(adjacency.sum(axis=1)) - adjacency
    result[0, 0] += scale
    return result


@pytest.mark.parametrize(("agents", "scale"), [(1, 1.0), (2, 1.0), (5, 1e-3), (5, 1.0), (6, 50.0), (8, 1e4), (20, 1.0)])
def test_against_forty_digits(agents: int, scale: float) -> None:
    z = laplacian(agents, scale, agents)
    with mpmath.workdps(40):
        exact = np.array(mpmath.expm(mpmath.matrix((-z).tolist())).tolist(), dtype=float)
    assert np.abs(exponential(-z) - exact).max() < 1e-15


def test_large() -> None:
    z = laplacian(150, 0.05, 3)
    assert np.abs(exponential(-z) - scipy.linalg.expm(-z)).max() < 1e-14
    assert np.array_equal(exponential(np.zeros((3, 3))), np.eye(3))


def test_the_product_is_as_good_as_any() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(40, 40)), rng.normal(size=(40, 40))
    assert np.abs(reproducible_product(a, b) - a @ b).max() < 1e-13
    permuted = rng.permutation(40)  # another order of the sums
    assert np.array_equal(reproducible_product(a[:, permuted], b[permuted]), reproducible_product(a, b))


CODE = """
import hashlib, sys
sys.path.insert(0, {here!r})
from test_matrix_exponential import laplacian
from msg_analysis.arithmetic.reproducible import exponential
print(hashlib.sha256(b"".join(exponential(-laplacian(m, 1.0, m)).tobytes() for m in (3, 9, 64))).hexdigest())
"""


def test_the_same_on_another_processor() -> None:
    other = another_processor()
    code = CODE.format(here=os.path.dirname(__file__))  # noqa: PTH120
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | other | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    here = b"".join(exponential(-laplacian(m, 1.0, m)).tobytes() for m in (3, 9, 64))
    assert done.stdout.strip() == hashlib.sha256(here).hexdigest()
