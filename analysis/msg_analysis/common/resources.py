# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Cores, threads of linear algebra, the progress of long work, and the versions of the software."""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from msg_analysis.errors import NotAvailableError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

    from msg_analysis.experiment.experiment import Experiment

try:
    __version__ = version("msg_analysis")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0.0.0"


def available_cores() -> list[int]:
    """Their numbers, ascending; none where the system does not say (not Linux)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def count_cores() -> int:
    """How many there are; all of the machine where the system does not say."""
    return len(available_cores()) or os.cpu_count() or 1


SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment of processes whose arithmetic is too small for threads: they would only compete for the cores."""

LARGE = 500  # smallest number of agents with which more than one thread pays on a quiet machine


P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread, in the libraries that are loaded when it begins."""
    limit: AbstractContextManager[Any] = _controller(with_scipy="scipy.linalg" in sys.modules).limit(
        limits=1, user_api="blas"
    )
    return limit


def blas_threads(agents: int) -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread for networks of this size, unless they are large."""
    # Its threads wait for each other without sleeping. Where another program keeps a core busy, every product of small
    # matrices then takes as long as a time slice: a comparison of 20 agents took 3 minutes instead of 4 s.
    if agents >= LARGE:
        return nullcontext()
    import scipy.linalg  # noqa: F401  it brings a library of its own

    return one_blas_thread()


def few_blas_threads(function: Callable[Concatenate[Experiment, P], R]) -> Callable[Concatenate[Experiment, P], R]:
    """Decorator: call a function of an experiment within ``blas_threads``."""

    @functools.wraps(function)
    def limited(experiment: Experiment, /, *arguments: P.args, **options: P.kwargs) -> R:
        with blas_threads(experiment.agents):
            return function(experiment, *arguments, **options)

    return limited


@functools.cache  # it looks through all loaded libraries, which takes milliseconds
def _controller(*, with_scipy: bool) -> ThreadpoolController:  # noqa: ARG001  each has found other libraries
    import numpy  # noqa: F401  the library must be loaded
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


Watch = Callable[[str, int, int], None]
"""Takes what is being done, how much of it is done, and how much there is to do, in any unit."""

_watch: ContextVar[Watch | None] = ContextVar("watch", default=None)


@contextmanager
def watched(watch: Watch) -> Iterator[None]:
    """Call ``watch`` in this context, often, by what is done in it."""
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


def tell(what: str, done: int, total: int) -> None:
    """Say how far the work is."""
    watch = _watch.get()
    if watch is not None:
        watch(what, done, total)


@functools.cache
def ros_distribution() -> str:
    """Name of the ROS 2 that rclpy is imported from: jazzy, kilted, ...; empty where nothing tells it."""
    spec = importlib.util.find_spec("rclpy")
    place = Path(spec.origin).parents[1] if spec is not None and spec.origin else None
    return distribution_at(place, os.environ.get("ROS_DISTRO", ""))


def distribution_at(place: Path | None, sourced: str) -> str:
    """The same, for an rclpy in the folder ``place`` and the ROS_DISTRO of a sourced ROS 2."""
    # Wheels set no variable; ros-<name>-rclpy is installed beside theirs. ROS_DISTRO may be that of another ROS 2 then.
    wheels = sorted(place.glob("ros_*_rclpy-*.dist-info")) if place else []
    return wheels[0].name.split("_")[1] if wheels else sourced


def pyarrow_problem() -> str | None:
    """Why pyarrow cannot be loaded, for example since it needs a newer NumPy; None: it can."""
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        return str(error)
    return None


def require_pyarrow(what: str) -> None:
    """NotAvailableError where pyarrow cannot be loaded, which something needs."""
    if problem := pyarrow_problem():
        raise NotAvailableError(f"{what}: pyarrow cannot be loaded ({problem}): install a version that fits")


def available_memory() -> int:
    """Available bytes: what Linux estimates as available, elsewhere all physical memory."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass  # not Linux: all physical memory is the next best number
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
