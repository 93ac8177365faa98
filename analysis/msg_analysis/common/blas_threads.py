"""Threads of the library for linear algebra (BLAS)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

LARGE = 500  # smallest number of agents with which more than one thread pays on a quiet machine


class Network(Protocol):
    """What has a number of agents: an experiment."""

    @property
    def agents(self) -> int:
        """Their number."""


N = TypeVar("N", bound=Network)
P = ParamSpec("P")
R = TypeVar("R")


def blas_threads(agents: int) -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread for networks of this size, unless they are large.

    Its threads wait for each other without sleeping. Where another program keeps a core busy, every product of small
    matrices then takes as long as a time slice: a comparison of 20 agents took 3 minutes instead of 4 s.
    """
    return nullcontext() if agents >= LARGE else _controller().limit(limits=1, user_api="blas")


def few_blas_threads(function: Callable[Concatenate[N, P], R]) -> Callable[Concatenate[N, P], R]:
    """Decorator: call a function of an experiment within ``blas_threads``."""

    @functools.wraps(function)
    def limited(network: N, /, *arguments: P.args, **options: P.kwargs) -> R:
        with blas_threads(network.agents):
            return function(network, *arguments, **options)

    return limited


@functools.cache  # it looks through all loaded libraries
def _controller() -> ThreadpoolController:
    import numpy  # noqa: F401  the libraries must be loaded
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
