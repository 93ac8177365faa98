"""Oracle: plain matrix products."""

import numpy as np
import pytest

from msg_analysis.theory import packed_symmetric as symmetric


@pytest.fixture
def random():
    return np.random.default_rng(1)


def symmetric_matrices(random, d, count=2):
    a = random.standard_normal((count, d, d))
    return a + a.transpose(0, 2, 1)


@pytest.mark.parametrize("d", [0, 1, 2, 5])
def test_pack_and_unpack_are_inverse_and_keep_the_inner_product(random, d):
    a, b = symmetric_matrices(random, d)
    assert symmetric.pack(a).shape == (symmetric.size(d),)
    np.testing.assert_allclose(symmetric.unpack(symmetric.pack(a), d), a, rtol=1e-15)
    assert symmetric.pack(a) @ symmetric.pack(b) == pytest.approx(np.trace(a @ b), abs=1e-12)


@pytest.mark.parametrize("d", [1, 2, 5])
def test_lyapunov(random, d):
    c, _ = symmetric_matrices(random, d)
    w = random.standard_normal((d, d))
    np.testing.assert_allclose(symmetric.lyapunov(w) @ symmetric.pack(c), symmetric.pack(w @ c + c @ w.T), atol=1e-12)


def test_adjoint_is_the_transpose(random):
    c, h = symmetric_matrices(random, 4)
    w = random.standard_normal((4, 4))
    np.testing.assert_allclose(
        symmetric.unpack(symmetric.lyapunov(w).T @ symmetric.pack(h), 4),
        w.T @ h + h @ w,
        atol=1e-12,
    )
    assert np.trace(h @ (w @ c + c @ w.T)) == pytest.approx(np.trace((w.T @ h + h @ w) @ c))
