"""Starts the processes of a network, watches them and ends them: none outlives its parent."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from msg_agents.network import RECORDER, ProcessPlan

ESCALATION = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 5.0))
"""Signals and the seconds that a process has to obey each."""

POLL = 0.02  # s


@dataclass(slots=True)
class Child:
    """A process of the network.

    Attributes
    ----------
    plan : what it is
    process : the running process
    log : file with what it printed
    """

    plan: ProcessPlan
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.poll() is None

    @property
    def failure(self) -> str | None:
        """How it ended, if not well, in words."""
        code = self.process.poll()
        # A process that has done its part and hangs in the middleware's farewell ends itself by an alarm.
        if code is None or code in (0, -signal.SIGALRM):
            return None
        if code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exit code {code}"

    @property
    def resumes(self) -> bool:
        """Whether it was killed and can take over from itself. An error of its own would only come again."""
        code = self.process.poll()
        return self.plan.resumes and code is not None and code < 0

    def last_words(self) -> str:
        """The last line that it printed."""
        with contextlib.suppress(OSError):
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            return lines[-1] if lines else ""
        return ""


@dataclass(slots=True)
class Supervisor:
    """The processes of one run.

    Children live in sessions of their own, so that Ctrl-C in the terminal reaches the parent only, which then ends
    them in order. Each holds the reading end of a pipe whose writing end only the parent has: when the parent goes,
    however it goes, the pipe closes and the child leaves.

    Attributes
    ----------
    logs : directory for what the children print
    environment : theirs
    children : in the order of their start
    steps : newest step of every agent as far as reported
    """

    logs: Path
    environment: Mapping[str, str]
    children: list[Child] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    _lifeline: tuple[int, int] = field(default=(-1, -1), init=False)
    _status: tuple[int, int] = field(default=(-1, -1), init=False)
    _pending: bytes = field(default=b"", init=False)

    def start(self, plans: Sequence[ProcessPlan]) -> None:
        """Start all processes."""
        self._lifeline = os.pipe()
        self._status = os.pipe()
        os.set_blocking(self._status[0], False)
        self.children += [self._start(plan) for plan in plans]

    def restart(self, child: Child) -> None:
        """Start again what has been killed."""
        self.children[self.children.index(child)] = self._start(child.plan)

    def _start(self, plan: ProcessPlan) -> Child:
        log = self.logs / f"{plan.name}.log"
        options = ["--lifeline", str(self._lifeline[0])]
        descriptors = [self._lifeline[0]]
        if plan.name == "switcher":
            options += ["--status", str(self._status[1])]
            descriptors.append(self._status[1])
        with log.open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "msg_agents", *plan.arguments, *options],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(self.environment),
                pass_fds=descriptors,
                start_new_session=True,
            )
        return Child(plan, process, log)

    def read_status(self) -> None:
        """Take in what the switcher has reported since the last call."""
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self._status[0], 1 << 16):
                self._pending += chunk
        *lines, self._pending = self._pending.split(b"\n")
        if lines:
            self.steps = json.loads(lines[-1])

    @property
    def running(self) -> list[Child]:
        """Those that have not ended."""
        return [child for child in self.children if child.running]

    @property
    def failures(self) -> list[Child]:
        """Those that ended, and not well."""
        return [child for child in self.children if child.failure]

    def stop(self) -> None:
        """End everybody: the agents and the switcher first, so that the recorder gets all that they sent."""
        self._end([child for child in self.children if child.plan.name != RECORDER])
        self._end([child for child in self.children if child.plan.name == RECORDER])

    @staticmethod
    def _end(children: Sequence[Child]) -> None:
        for number, patience in ESCALATION:
            for child in children:
                if child.running:
                    child.process.send_signal(number)
            deadline = time.monotonic() + patience
            while any(child.running for child in children):
                if time.monotonic() > deadline:
                    break
                time.sleep(POLL)
            else:
                return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        for descriptor in (*self._lifeline, *self._status):
            with contextlib.suppress(OSError):
                os.close(descriptor)
