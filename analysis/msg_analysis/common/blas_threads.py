# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Threads of the library for linear algebra (BLAS)."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment of processes whose arithmetic is too small for threads: they would only compete for the cores."""

LARGE = 500  # smallest number of agents with which more than one thread pays on a quiet machine


class Network(Protocol):
    """What has a number of agents: an experiment."""

    @property
    def agents(self) -> int:
        """Their number."""


N = TypeVar("N", bound=Network)
P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread, in the libraries that are loaded when it begins."""
    limit: AbstractContextManager[Any] = _controller(with_scipy="scipy.linalg" in sys.modules).limit(
        limits=1, user_api="blas"
    )
    return limit


def blas_threads(agents: int) -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread for networks of this size, unless they are large.

    Its threads wait for each other without sleeping. Where another program keeps a core busy, every product of small
    matrices then takes as long as a time slice: a comparison of 20 agents took 3 minutes instead of 4 s.
    """
    if agents >= LARGE:
        return nullcontext()
    import scipy.linalg  # noqa: F401  it brings a library of its own

    return one_blas_thread()


def few_blas_threads(function: Callable[Concatenate[N, P], R]) -> Callable[Concatenate[N, P], R]:
    """Decorator: call a function of an experiment within ``blas_threads``."""

    @functools.wraps(function)
    def limited(network: N, /, *arguments: P.args, **options: P.kwargs) -> R:
        with blas_threads(network.agents):
            return function(network, *arguments, **options)

    return limited


@functools.cache  # it looks through all loaded libraries, which takes milliseconds
def _controller(*, with_scipy: bool) -> ThreadpoolController:  # noqa: ARG001  each has found other libraries
    import numpy  # noqa: F401  the library must be loaded
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
