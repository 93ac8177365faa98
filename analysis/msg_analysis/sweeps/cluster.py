# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import time
import uuid
import warnings
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from msg_analysis.errors import InputError
from msg_analysis.sweeps.points import installed_software
from msg_analysis.sweeps.workers import ENDING_TIMEOUT, Answer, Function, R, T, Workers, WorkersLostError, do

if TYPE_CHECKING:
    from distributed import Future

NOTICE = ENDING_TIMEOUT / 2  # s between two questions of a worker whether the work is being ended
PATIENCE = 10.0  # s until a scheduler answers


class ClusterWorkers(Workers):
    """Those of the Dask scheduler at an address. Whoever reaches its port can run code as its user, and as theirs."""

    queued = 2  # one that is worked on, one that is ready after it
    lost_if = (OSError, asyncio.CancelledError, concurrent.futures.CancelledError)

    def __init__(self, scheduler: str, *, patience: float = PATIENCE) -> None:
        self._scheduler, self._patience = scheduler, patience
        self._stop_name = f"msg-sweep-stop-{uuid.uuid4().hex}"

    def __enter__(self) -> Self:
        """Find the scheduler. InputError: none answers."""
        import distributed

        # Silence its logs: what matters to the user is raised as an error here.
        for name in list(logging.root.manager.loggerDict):
            if name.partition(".")[0] == "distributed":
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        warnings.filterwarnings("ignore", "Sending large graph")  # once for each batch, which takes longer
        try:
            self._client = distributed.Client(self._scheduler, timeout=self._patience, name="msg-analysis")
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).partition(":")[0] if isinstance(error, ValueError) else "no answer"
            wanted = "expected the address of a Dask scheduler: for example tcp://127.0.0.1:8786"
            raise InputError(f"--scheduler {self._scheduler}: {reason}: {wanted}") from error
        self._done = distributed.as_completed()
        return self

    def close(self) -> None:
        """See ``Workers``."""
        with suppress(Exception):
            self._client.close(timeout=5)

    @property
    def threads(self) -> int:
        """See ``Workers``."""
        return sum(self._client.nthreads().values())

    def submit(self, function: Function[T, R], batch: list[T]) -> Future:
        """See ``Workers``."""
        task = (_do_on_cluster, function, batch, self._stop_name, installed_software())
        future: Future = self._client.submit(*task, pure=False)
        self._done.add(future)
        return future

    def next_answer(self, running: Collection[Future]) -> tuple[Future, Answer | None]:  # noqa: ARG002
        """See ``Workers``."""
        future = next(self._done)
        return future, self._answer(future)

    def _answer(self, future: Future) -> Answer | None:
        from distributed import KilledWorker

        if future.status == "finished":
            found: Answer = future.result()
            return found
        if future.status == "error":
            error = future.exception()
            if isinstance(error, KilledWorker):
                return None
            if isinstance(error, ImportError):
                raise InputError(f"a worker cannot do it: {error}: install the same software there") from error
            assert error is not None
            raise error
        if self._client.status != "running":
            raise WorkersLostError("the scheduler has gone")
        return None  # the only worker that had the result died

    def stop(self, running: Collection[Future], timeout: float) -> None:
        """See ``Workers``."""
        from distributed import Event, wait

        Event(self._stop_name, client=self._client).set()
        wait(list(running), timeout=timeout)


def _do_on_cluster(function: Function[T, R], batch: Sequence[T], stop_name: str, software: str) -> Answer:
    """On a worker of a cluster: see ``do``. ImportError: it has other software."""
    if installed_software() != software:
        raise ImportError(f"it has {installed_software()}: expected {software}")
    return do(function, batch, _Stopping(stop_name))


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
