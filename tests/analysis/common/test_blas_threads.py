"""Threads of linear algebra: one for small networks, as many as there were for large ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg  # its library of linear algebra is another one than that of numpy
from threadpoolctl import threadpool_info, threadpool_limits

from msg_analysis.common.resources import LARGE, few_blas_threads


@dataclass
class Network:
    agents: int


@few_blas_threads
def threads(network: Network, size: int, *, more: int = 0) -> set[int]:
    """Of BLAS, while this runs."""
    assert scipy.linalg.norm(np.ones(size + more)) == pytest.approx((size + more) ** 0.5)
    assert network.agents > 0
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_small_networks_have_one_thread() -> None:
    with threadpool_limits(3, user_api="blas"):
        before = {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}
        assert threads(Network(LARGE - 1), 2, more=1) == {1}
        assert threads(Network(LARGE), 2) == before
        assert threads(Network(5), 2) == {1}
        assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == before
