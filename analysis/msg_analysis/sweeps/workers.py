# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The jobs of a sweep on workers: processes of this machine, or a Dask cluster; a worker that dies is replaced."""

from __future__ import annotations

import asyncio
import concurrent.futures
import dataclasses
import logging
import math
import multiprocessing
import os
import signal
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

from msg_analysis.common.resources import SINGLE_THREAD, count_cores, one_blas_thread
from msg_analysis.errors import InputError
from msg_analysis.sweeps.points import FAILED, Job, JobResults, NetworkOptions, Outcome, evaluate, installed_software

if TYPE_CHECKING:
    from distributed import Future

    from msg_analysis.sweeps.results import ResultStore


T = TypeVar("T")
R = TypeVar("R")

BATCH_SECONDS = 0.5  # s of work per task, next to which the few milliseconds that Dask needs for it do not matter
MOST_IN_BATCH = 500
QUEUED = 2  # tasks sent per thread of the workers: one that is worked on, one that is ready after it
NOTICE = 0.5  # s between two checks of a worker whether the work is being ended
# Signals that end a sweep as Ctrl-C does: that of a cluster's queue, and that of a terminal that is closed.
ENDING = (signal.SIGTERM, signal.SIGHUP)
PATIENCE = 10.0  # s until a scheduler answers
NETWORK_TIMEOUT = 60.0  # s that running networks have to end in order
# Less of what Dask does besides the work, which costs time on two cores.
_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
}
_NEEDED = ("msg_analysis.theory.prediction", "msg_analysis.inference.verdict", "msg_analysis.twin.simulate")

# What is done with an item; the second argument says whether the work is being ended.
Function = Callable[[T, Callable[[], bool]], R]
OtherSoftware = Literal["refuse", "redo", "keep"]
SweepProgress = Callable[[int, int, int], None]  # outcomes available, total, how many of them failed


class WorkersLostError(Exception):
    """The cluster went away in the middle of the work."""


class EndedError(Exception):
    """The work was ended before it was done."""


@dataclass(frozen=True, slots=True)
class Lost:
    """In place of a result: the item killed every worker that tried it."""

    reason: str  # for the user


def warm_up() -> None:
    """Begin to start the server that workers are forked from: it imports while this process does other things."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return
    from multiprocessing import forkserver

    previous = {name: os.environ.get(name) for name in SINGLE_THREAD}
    os.environ.update(SINGLE_THREAD)
    with _ignoring(signal.SIGINT):  # and so do the workers: this process ends them
        multiprocessing.get_context("forkserver").set_forkserver_preload(["distributed", *_NEEDED])
        forkserver.ensure_running()
    for name, value in previous.items():
        del os.environ[name]
        if value is not None:
            os.environ[name] = value


class Workers:
    """Worker processes of this machine (None: one per CPU), or those of the Dask scheduler at an address."""

    def __init__(self, count: int | None = None, scheduler: str | None = None, *, patience: float = PATIENCE) -> None:
        self._count = count or count_cores()
        self._scheduler, self._patience = scheduler, patience
        self._client: Any = None  # of Dask, from ``__enter__`` on
        self._cluster: Any = None
        self._stop_name = f"msg-sweep-stop-{uuid.uuid4().hex}"

    def __enter__(self) -> Self:
        """Start or find the workers. InputError: no scheduler answers, or its workers have other software."""
        import dask

        if not self._scheduler:
            warm_up()
        import distributed

        # Silence its logs: what matters to the user is raised as an error here.
        for name in list(logging.root.manager.loggerDict):
            if name.partition(".")[0] == "distributed":
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        if self._scheduler:
            try:
                self._client = distributed.Client(self._scheduler, timeout=self._patience, name="msg-analysis")
            except (OSError, ValueError, TypeError) as error:
                reason = str(error).partition(":")[0] if isinstance(error, ValueError) else "no answer"
                wanted = "expected the address of a Dask scheduler: for example tcp://127.0.0.1:8786"
                raise InputError(f"--scheduler {self._scheduler}: {reason}: {wanted}") from error
            self._compare_software()
            return self
        method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        dask.config.set({"distributed.worker.multiprocessing-method": method, **_QUIET})
        try:
            with deferring_interrupts():
                quiet = {"scheduler_kwargs": {"dashboard": False}, "silence_logs": logging.CRITICAL + 1}
                place = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
                size = {"n_workers": self._count, "threads_per_worker": 1, "processes": True}
                self._cluster = distributed.LocalCluster(**size, **place, **quiet)
                self._client = distributed.Client(self._cluster)
        except KeyboardInterrupt:
            self._close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        # A second Ctrl-C must not interrupt the orderly end.
        with _ignoring(signal.SIGINT, signal.SIGTERM), suppress(Exception):
            if self._client is not None:
                self._client.close(timeout=5)
            if self._cluster is not None:
                self._cluster.close(timeout=20)

    @property
    def threads(self) -> int:
        """Items that can be worked on at a time now; 0 where a cluster has no worker yet."""
        return sum(self._client.nthreads().values()) if self._scheduler else self._count

    def outcomes(
        self, function: Function[T, R], items: Sequence[T], *, timeout: float = 2 * NOTICE
    ) -> Generator[list[tuple[T, R | Lost]], None, None]:
        """Results of ``function`` (at the top of a module), in batches; interrupted, work has ``timeout`` s to end.

        WorkersLostError: the scheduler is gone; InputError: other software on a worker.
        """
        from distributed import as_completed

        pending = deque(items)
        suspected: deque[T] = deque()
        running: dict[Future, list[T]] = {}
        seconds = math.inf
        done = as_completed()
        try:
            while pending or suspected or running:
                while pending and len(running) < QUEUED * max(self.threads, 1):
                    self._submit(function, _take(pending, seconds, self.threads), running, done)
                alone = not running
                if alone:
                    self._submit(function, [suspected.popleft()], running, done)
                future = next(done)
                batch = running.pop(future)
                found = self._result(future)
                if found is not None:
                    results, took = found
                    each = took / len(batch)
                    seconds = each if math.isinf(seconds) else 0.7 * seconds + 0.3 * each
                    yield list(zip(batch, results, strict=True))
                elif alone:
                    yield [(batch[0], Lost("killed every worker that tried it, or used up its memory"))]
                else:  # an item of it killed them, or one that a worker had at the same time: each is tried alone
                    suspected += batch
        except BaseException as error:
            self._stop(list(running), timeout)
            if isinstance(error, OSError | asyncio.CancelledError | concurrent.futures.CancelledError):
                raise WorkersLostError("the scheduler has gone") from error
            raise

    def _submit(self, function: Function[T, R], batch: list[T], running: dict[Future, list[T]], done: Any) -> None:
        future = self._client.submit(_do, function, batch, self._stop_name, installed_software(), pure=False)
        running[future] = batch
        done.add(future)

    def _result(self, future: Future) -> tuple[list[Any], float] | None:
        """Results of a batch and the seconds that it took; None where workers died over and over."""
        from distributed import KilledWorker

        if future.status == "finished":
            found: tuple[list[Any], float] = future.result()
            return found
        if future.status == "error":
            error = future.exception()
            if isinstance(error, KilledWorker):
                return None
            if isinstance(error, ModuleNotFoundError | InputError):
                raise InputError(f"a worker cannot do it: {error}: install the same software there") from error
            assert error is not None
            raise error
        if self._client.status != "running":
            raise WorkersLostError("the scheduler has gone")
        return None  # the only worker that had the result died

    def _stop(self, running: Sequence[Future], timeout: float) -> None:
        """Tell the workers to stop, and wait up to ``timeout`` seconds for the running batches."""
        from distributed import Event, wait

        with _ignoring(signal.SIGINT, signal.SIGTERM), suppress(Exception):
            Event(self._stop_name, client=self._client).set()
            wait(running, timeout=timeout)

    def _compare_software(self) -> None:
        """Refuse workers with other software; those that join later refuse themselves in ``_do``."""
        where, own = f"--scheduler {self._scheduler}", installed_software()
        try:
            found = self._client.run(installed_software)
        except ModuleNotFoundError as error:
            raise InputError(f"{where}: {error}: install the same software on its workers") from error
        for worker, other in found.items():
            if other != own:
                raise InputError(
                    f"{where}: worker {worker} has {other}: expected {own}: install the same software there"
                )


def _take(pending: deque[T], seconds: float, threads: int) -> list[T]:
    """As many items as make a batch; fewer towards the end, so that all workers end together."""
    most = 1 if math.isinf(seconds) else int(BATCH_SECONDS / max(seconds, 1e-9))
    most = max(1, min(most, MOST_IN_BATCH, len(pending) // (QUEUED * max(threads, 1))))
    return [pending.popleft() for _ in range(most)]


def _do(function: Function[T, R], batch: Sequence[T], stop_name: str, software: str) -> tuple[list[R], float]:
    """On a worker: do a batch, and time it [s]; one thread of linear algebra, since there is a worker for every CPU."""
    if installed_software() != software:
        raise InputError(f"it has {installed_software()}: expected {software}")
    stopping = _Stopping(stop_name)
    begin = time.perf_counter()
    results = []
    with one_blas_thread():
        for item in batch:
            if stopping():
                raise EndedError
            results.append(function(item, stopping))
    return results, time.perf_counter() - begin


class _Stopping:
    """Whether the work is to end; asks the scheduler every ``NOTICE`` seconds, and is true if that has gone."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._asked = time.monotonic()
        self._answer = False

    def __call__(self) -> bool:
        from distributed import Event

        if not self._answer and time.monotonic() >= self._asked + NOTICE:
            self._asked = time.monotonic()
            try:
                self._answer = bool(Event(self._name).is_set())
            except Exception:
                self._answer = True
        return self._answer


@contextmanager
def _handling(handler: Any, numbers: Iterable[signal.Signals]) -> Iterator[None]:
    """Another handler of signals for a while, if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in previous.items():
            signal.signal(number, former)


def _ignoring(*numbers: signal.Signals) -> AbstractContextManager[None]:
    """Ignore signals for a while; processes started meanwhile ignore them for good."""
    return _handling(signal.SIG_IGN, numbers)


@contextmanager
def deferring_interrupts() -> Iterator[None]:
    """Postpone signals that end the program until the block is done; then the first one is raised."""
    received: list[int] = []
    numbers = [signal.SIGINT, *(number for number in ENDING if callable(signal.getsignal(number)))]
    with _handling(lambda number, _: received.append(number), numbers):
        yield
    if received:
        signal.raise_signal(received[0])


def run_jobs(
    jobs: Sequence[Job],  # equal ones are done once
    store: ResultStore,
    *,
    workers: int | None = None,  # processes here; None: one per CPU, or a single one where networks run
    scheduler: str | None = None,  # of a Dask cluster, whose workers are used instead
    network: NetworkOptions | None = None,  # needed where jobs run networks
    other_software: OtherSoftware = "refuse",  # what to do with outcomes that other software made
    retry: bool = False,  # whether failed jobs are done again
    watch: SweepProgress = lambda _done, _total, _failed: None,
) -> JobResults:
    """Do what has not been done. InputError: outcomes of other software, or no workers; WorkersLostError: they went."""
    todo = _todo(jobs, store, other_software, retry)
    reused = len(jobs) - sum(job.id in todo for job in jobs)
    total = len({job.id for job in jobs})
    failed = sum(store.outcomes[job.id].status == FAILED for job in jobs if job.id not in todo)
    done = total - len(todo)
    watch(done, total, failed)
    if todo:
        runs_networks = any(job.kind == "network" for job in todo.values())
        if runs_networks and not scheduler:
            workers = workers or 1
        items = [dataclasses.replace(job, network=network) for job in todo.values()]
        timeout = {"timeout": NETWORK_TIMEOUT} if runs_networks else {}
        with Workers(workers, scheduler) as pool, closing(pool.outcomes(evaluate, items, **timeout)) as batches:
            for batch in batches:
                found = [
                    Outcome(job.id, FAILED, result.reason, {}, 0.0, "", installed_software())
                    if isinstance(result, Lost)
                    else result
                    for job, result in batch
                ]
                with deferring_interrupts():  # the outcomes that are counted are on the disk
                    store.add(found)
                done += len(found)
                failed += sum(outcome.status == FAILED for outcome in found)
                watch(done, total, failed)
    return JobResults(tuple(store.outcomes[job.id] for job in jobs), reused)


def _todo(jobs: Sequence[Job], store: ResultStore, other_software: OtherSoftware, retry: bool) -> dict[str, Job]:
    """The jobs that have to be done, by id."""
    todo, others = {}, {}
    for job in jobs:
        known = store.outcomes.get(job.id)
        if known is None or (retry and known.status == FAILED):
            todo[job.id] = job
        elif known.software != installed_software() and other_software != "keep":
            others[job.id] = known.software
            todo[job.id] = job
    if others and other_software == "refuse":
        was = " and ".join(sorted(set(others.values())))
        raise InputError(
            f"{store.directory}: {len(others)} results were made with other software ({was}), not "
            f"{installed_software()}: choose another --out, or use --other-software redo or keep"
        )
    return todo
