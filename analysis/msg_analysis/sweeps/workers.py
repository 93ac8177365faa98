# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The jobs of a sweep on workers, which are processes of this machine by default; one that dies is replaced."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import math
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeVar, cast

from msg_analysis.common import programs
from msg_analysis.common.resources import SINGLE_THREAD, count_cores, one_blas_thread
from msg_analysis.errors import InputError
from msg_analysis.sweeps.points import FAILED, Job, JobResults, NetworkOptions, Outcome, evaluate, installed_software

if TYPE_CHECKING:
    from msg_analysis.sweeps.results import ResultStore


T = TypeVar("T")
R = TypeVar("R")

BATCH_SECONDS = 0.5  # s of work per batch, next to which the few milliseconds that it takes to send it do not matter
MOST_IN_BATCH = 500
SHARES = 2  # batches per thread that what is left is divided into, so that all workers end together
ENDING_TIMEOUT = 1.0  # s that work has to end
# Signals that end a sweep as Ctrl-C does: that of a cluster's queue, and that of a terminal that is closed.
ENDING = (signal.SIGTERM, signal.SIGHUP)
NETWORK_TIMEOUT = 60.0  # s that running networks have to end in order
MOST_FAILED_STARTS = 5  # workers in a row that end before they can do anything, until the work is given up
LEAST_MEMORY = 1 << 30  # bytes of a worker, however many there are
STDERR = 2  # for what protocols print: stdout has the results
SERVE = "from msg_analysis.sweeps.workers import serve; serve({}, {}, {})"
READY = "ready"

# What is done with an item; the second argument says whether the work is being ended.
Function = Callable[[T, Callable[[], bool]], R]
Answer = tuple[list[Any], float]  # results of a batch, and the seconds that it took
OtherSoftware = Literal["refuse", "redo", "keep"]
SweepProgress = Callable[[int, int, int], None]  # outcomes available, total, how many of them failed


class WorkersLostError(Exception):
    """The workers went away in the middle of the work."""


class EndedError(Exception):
    """The work was ended before it was done."""


@dataclass(frozen=True, slots=True)
class Lost:
    """In place of a result: the item killed every worker that tried it."""

    reason: str  # for the user


class Workers(ABC):
    """What works on items, batch by batch; a context, at whose end the processes of this machine are gone."""

    queued: ClassVar[int] = 1  # batches sent per thread
    lost_if: ClassVar[tuple[type[BaseException], ...]] = ()  # errors that say that all workers have gone

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with _ignoring(signal.SIGINT, signal.SIGTERM):  # a second Ctrl-C must not interrupt the orderly end
            self.close()

    @property
    @abstractmethod
    def threads(self) -> int:
        """Items that can be worked on at a time now; 0 where a cluster has no worker yet."""

    @abstractmethod
    def submit(self, function: Function[T, R], batch: list[T]) -> Any:
        """Send a batch; a key for it."""

    @abstractmethod
    def next_answer(self, running: Collection[Any]) -> tuple[Any, Answer | None]:
        """Wait for a batch, one of these keys; no answer: its workers died."""

    @abstractmethod
    def stop(self, running: Collection[Any], timeout: float) -> None:
        """Tell the workers to stop, and wait up to ``timeout`` seconds for the running batches."""

    @abstractmethod
    def close(self) -> None:
        """End what was begun."""

    def outcomes(
        self, function: Function[T, R], items: Sequence[T], *, timeout: float = ENDING_TIMEOUT
    ) -> Generator[list[tuple[T, R | Lost]], None, None]:
        """Results of ``function`` (at the top of a module), in batches; interrupted, work has ``timeout`` s to end.

        WorkersLostError: the workers are gone; InputError: other software on a worker.
        """
        pending = deque(items)
        suspected: deque[T] = deque()
        running: dict[Any, list[T]] = {}
        seconds = math.inf
        try:
            while pending or suspected or running:
                while pending and len(running) < self.queued * max(self.threads, 1):
                    batch = _take(pending, seconds, self.threads)
                    running[self.submit(function, batch)] = batch
                alone = not running
                if alone:
                    batch = [suspected.popleft()]
                    running[self.submit(function, batch)] = batch
                key, answer = self.next_answer(running)
                batch = running.pop(key)
                if answer is not None:
                    results, took = answer
                    each = took / len(batch)
                    seconds = each if math.isinf(seconds) else 0.7 * seconds + 0.3 * each
                    yield list(zip(batch, results, strict=True))
                elif alone:
                    yield [(batch[0], Lost("killed every worker that tried it, or used up its memory"))]
                else:  # an item of it killed them, or one that a worker had at the same time: each is tried alone
                    suspected += batch
        except BaseException as error:
            with _ignoring(signal.SIGINT, signal.SIGTERM), suppress(Exception):
                self.stop(list(running), timeout)
            if isinstance(error, self.lost_if):
                raise WorkersLostError("the scheduler has gone") from error
            raise


class LocalWorkers(Workers):
    """Processes of this machine (None: one per CPU), each with a pair of sockets that no other process can reach."""

    def __init__(self, count: int | None = None) -> None:
        self._count = count or count_cores()
        self._processes: dict[Connection, subprocess.Popen[bytes]] = {}
        self._idle: list[Connection] = []
        self._failed_starts = 0  # in a row

    @property
    def threads(self) -> int:
        """See ``Workers``."""
        return self._count

    def submit(self, function: Function[T, R], batch: list[T]) -> Connection:
        """See ``Workers``."""
        connection = self._idle.pop() if self._idle else self._start()
        with suppress(OSError):  # it has died: ``next_answer`` finds out
            connection.send((function, batch))
        return connection

    def _start(self) -> Connection:
        ours, theirs = socket.socketpair()
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // self._count
        command = SERVE.format(theirs.fileno(), os.getpid(), max(memory, LEAST_MEMORY))
        try:
            process = programs.start(
                [sys.executable, "-c", command],
                {**os.environ, **SINGLE_THREAD},
                stdout=STDERR,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C in the terminal ends this process, which then ends the workers
            )
        except OSError as error:
            number = len(self._processes) + 1
            raise InputError(f"--workers: number {number} cannot be started ({error.strerror}): give fewer") from error
        finally:
            theirs.close()
        connection = Connection(ours.detach())
        self._processes[connection] = process
        with suppress(OSError):
            connection.send(sys.path)
        return connection

    def next_answer(self, running: Collection[Connection]) -> tuple[Connection, Answer | None]:
        """See ``Workers``."""
        while True:
            connection = cast(Connection, wait(list(running))[0])
            try:
                answer = connection.recv()
            except (EOFError, OSError):
                self._remove(connection)
                return connection, None
            self._failed_starts = 0
            if answer == READY:
                continue
            self._idle.append(connection)
            if isinstance(answer, BaseException):
                raise answer
            return connection, answer

    def _remove(self, connection: Connection) -> None:
        process = self._processes.pop(connection)
        connection.close()
        process.kill()
        code = process.wait()
        self._failed_starts += 1
        if self._failed_starts > MOST_FAILED_STARTS:
            raise WorkersLostError(f"worker processes cannot be started: exit code {code}")

    def stop(self, running: Collection[Connection], timeout: float) -> None:
        """See ``Workers``."""
        for connection in running:
            with suppress(OSError):
                connection.send(None)
        deadline = time.monotonic() + timeout
        for connection in running:
            with suppress(subprocess.TimeoutExpired):
                self._processes[connection].wait(max(0.0, deadline - time.monotonic()))

    def close(self) -> None:
        """See ``Workers``."""
        for process in self._processes.values():
            process.kill()
        for connection, process in self._processes.items():
            connection.close()
            process.wait()
        self._processes.clear()
        self._idle.clear()


def serve(descriptor: int, parent: int, memory: int) -> None:
    """In a worker of this machine: do batches, with so many bytes of memory, until there are no more."""
    programs.end_with_parent(parent)
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (memory if most < 0 else min(memory, most), most))
    connection = Connection(descriptor)
    os.set_inheritable(descriptor, False)  # if a program that it starts had it, our end would not be noticed
    sys.path[:] = connection.recv()
    connection.send(READY)
    with suppress(EOFError):
        while task := connection.recv():
            function, batch = task
            try:
                answer: Answer | Exception = do(function, batch, connection.poll)  # what comes meanwhile is the end
            except Exception as error:
                answer = error
            connection.send(answer)


def _take(pending: deque[T], seconds: float, threads: int) -> list[T]:
    """As many items as make a batch; fewer towards the end, so that all workers end together."""
    most = 1 if math.isinf(seconds) else int(BATCH_SECONDS / max(seconds, 1e-9))
    most = max(1, min(most, MOST_IN_BATCH, len(pending) // (SHARES * max(threads, 1))))
    return [pending.popleft() for _ in range(most)]


def do(function: Function[T, R], batch: Sequence[T], stopping: Callable[[], bool]) -> tuple[list[R], float]:
    """On a worker: do a batch, and time it [s]; one thread of linear algebra, since there is a worker for every CPU."""
    begin = time.perf_counter()
    results = []
    with one_blas_thread():
        for item in batch:
            if stopping():
                raise EndedError
            results.append(function(item, stopping))
    return results, time.perf_counter() - begin


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
        with _workers(workers, scheduler) as pool, closing(pool.outcomes(evaluate, items, **timeout)) as batches:
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


MANY = 2**20  # numbers in one sequence of batches
JOINING = 5.0  # s in which the first worker of a cluster joins it


def in_order(function: Function[int, R], workers: int | None, scheduler: str | None) -> Generator[R, None, None]:
    """Results for 0, 1, ... without end, in this order, whichever comes first. InputError: no workers, or they went."""
    try:
        with _workers(workers, scheduler) as pool:
            began = time.monotonic()
            while not pool.threads and time.monotonic() < began + JOINING:
                time.sleep(0.1)
            if not pool.threads:
                raise InputError(f"--scheduler {scheduler}: has no workers: expected some: start `dask worker`")
            for first in itertools.count(step=MANY):
                early: dict[int, R | Lost] = {}
                with closing(pool.outcomes(function, range(first, first + MANY))) as batches:
                    wanted = first
                    for batch in batches:
                        early.update(batch)
                        while wanted in early:
                            found = early.pop(wanted)
                            if isinstance(found, Lost):
                                raise InputError(f"batch {wanted}: {found.reason}: use fewer workers, with more memory")
                            yield found
                            wanted += 1
    except WorkersLostError as error:
        raise InputError(f"{error}: expected workers until the end: start them again") from error


def _workers(count: int | None, scheduler: str | None) -> Workers:
    if scheduler is None:
        return LocalWorkers(count)
    if importlib.util.find_spec("distributed") is None:
        raise InputError("distributed: not installed: --scheduler needs it: pip install distributed")
    from msg_analysis.sweeps.cluster import ClusterWorkers  # Dask

    return ClusterWorkers(scheduler)


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
