# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Starts the processes of a network, watches them and ends them: none outlives its parent, none that has hung stays."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from msg_agents.discovery.relay import DiscoveryRelay
from msg_agents.process_layout import CHANNEL, RECORDER, SWITCHER, Process, ProcessSpec, pin_to_core
from msg_agents.run.fork_server import SHOW_STACKS, ForkServer, NodeStart
from msg_agents.run.result import StatusSummary, read_report, read_status_files, read_steps
from msg_agents.stepping.monitoring import LONGEST_LOOK
from msg_analysis.common import programs
from msg_analysis.common.text import with_names
from msg_analysis.errors import ExitCode

# Signals and the seconds that a process has to obey each; the second ones for one that has hung.
ESCALATION = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 5.0))
AFTER_HANG = ((SHOW_STACKS, 0.5), (signal.SIGKILL, 5.0))
AT_ONCE = 50  # processes that are started together: so many log files are then open
POLL = 0.02  # s
CHECK_PERIOD = 1.0  # s between two checks whether processes have hung
SILENCE = 3.0  # s; status files are written once a second
CHANNEL_SILENCE = 10.0  # s after which a channel that reports nothing is given up
SEND_PERIOD = 0.5  # s of wall time after which agents send the recorder what they have for it in any case
DRAIN_TIME = 3.0  # s
EARLY = 3.0  # s after which an agent that has ended without its last step is not waited for any more
LATE = 10.0  # s after the end of the run after which a process that has not left is not waited for any more
CRASHED = 1, ExitCode.FAULT  # exit codes after an uncaught exception, of Python and of a command
STATUS_FOLDER, STEPS, CLOCKS = "status", "steps.json", "clocks.json"

HUNG = 60.0  # s
WAITS = "S"  # of the states of proc(5): neither running, nor waiting for a disk, stopped or traced


class HungDetector:
    """Watches one process; where the system does not say when threads run, no process has ever hung."""

    # It has hung when its main thread waits, and has not run for a minute, though nobody has stopped it. That of a node
    # that waits for others, for its clock, or for a slow reader still runs several times a second.
    def __init__(
        self, pid: int, *, clock: Callable[[], float] = time.monotonic, wall: Callable[[], float] = time.time
    ) -> None:
        self._pid, self._clock, self._wall = pid, clock, wall
        self._ran: str | None = None  # ns for which its main thread had run when it was looked at
        self._looked, self._latest, self._still = clock(), wall(), 0.0

    def update(self, timeout: float = HUNG) -> str | None:
        """Look at it, about once a second; in words that it has hung, or None."""
        now, before, self._ran = self._clock(), self._ran, _run_time(self._pid)
        elapsed, self._looked = min(now - self._looked, LONGEST_LOOK), now
        # The system's clock may have been set back. Waits of the middleware then last until it is there again.
        wall = self._wall()
        counts = wall >= self._latest and self._ran is not None and self._ran == before
        self._latest = max(wall, self._latest)
        self._still = self._still + elapsed if counts else 0.0
        return f"hung, its main thread has not run for {timeout:g} s" if self._still >= timeout else None


def _run_time(pid: int) -> str | None:
    """For how long the main thread of a process has run [ns], if it waits now and the system counts that (Linux)."""
    with contextlib.suppress(OSError, IndexError):
        ran = Path(f"/proc/{pid}/task/{pid}/schedstat").read_text(encoding="ascii").split()[0]
        return ran if _state(pid) == WAITS and ran != "0" else None
    return None


def _state(pid: int) -> str | None:
    """State of the main thread of a process, a letter of proc(5); None: not known."""
    with contextlib.suppress(OSError, IndexError):
        text = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
        return text.rpartition(")")[2].split()[0]
    return None


def failure_of(code: int) -> str | None:
    """How a process failed, in words, from its exit code or minus the signal that killed it; None if it ended well."""
    if code == 0:
        return None
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


@dataclass(slots=True)
class Child:
    """A process of the network."""

    spec: ProcessSpec
    process: Process
    log: Path  # file of what it printed
    number: int = 1  # of this start; 2: restarted once
    ended: float | None = None  # when it was first seen to have ended with exit code 0 [s]
    early: bool = False  # whether it did so before its last step
    end_reason: str | None = None  # why it was ended
    dismissed: bool = False  # whether it was interrupted because the run was over
    detector: HungDetector = field(init=False)

    def __post_init__(self) -> None:
        self.detector = HungDetector(self.process.pid)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    @property
    def stopped(self) -> bool:
        """Whether somebody has stopped it (SIGSTOP, a debugger); Linux."""
        return _state(self.process.pid) in ("T", "t")

    @property
    def status_age(self) -> float:
        """Seconds since it last wrote its status file; inf: never."""
        path = self.log.parent / STATUS_FOLDER / f"{self.spec.name}.{self.number}.json"
        try:
            return time.time() - path.stat().st_mtime
        except OSError:
            return math.inf

    @property
    def ended_well(self) -> bool:
        """Whether it has ended and done its part."""
        return self.process.poll() is not None and self.failure is None

    @property
    def failure(self) -> str | None:
        """How it failed, in words; None if it is running or has ended well."""
        code = self.process.poll()
        if self.end_reason:
            return self.end_reason
        if self.early:
            return f"exit code {code} before its last step"
        if self.dismissed and code == ExitCode.INCOMPLETE:
            return None
        return None if code is None else failure_of(code)

    @property
    def resumes(self) -> bool:
        """Whether it can take over from itself, and starting it again makes sense: not after bad input, for example."""
        code = self.process.poll()
        if not self.spec.resumes or code is None:
            return False
        return code < 0 or (code in CRASHED and self.number == 1)  # a crash of its own will probably repeat: one try

    def has_traceback(self) -> bool:
        """Whether it has printed one."""
        with contextlib.suppress(OSError):
            return "Traceback (most recent call last)" in self.log.read_text(encoding="utf-8", errors="replace")
        return False

    def last_line(self) -> str:
        """The last line that it printed; none of one that was ended, since it did not say why."""
        if self.end_reason:
            return ""
        with contextlib.suppress(OSError):
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            return lines[-1] if lines else ""
        return ""


@dataclass(slots=True)
class Supervisor:
    """The processes of one run; at the end of the context they are ended."""

    # They have sessions of their own, so that Ctrl-C reaches only the parent; they end when its pipe to them closes.
    logs: Path  # directory for what the children print
    environment: Mapping[str, str]  # of the children
    children: list[Child] = field(default_factory=list)  # as started; a restarted one keeps its place
    steps: list[int] = field(default_factory=list)  # newest step of every agent, as reported
    cores: Mapping[str, int] = field(default_factory=dict)  # by name of the process; the others are not pinned
    last_step: int = 0  # of the run
    fork_server: ForkServer | None = None  # without one, or when it has ended, every child starts on its own
    relay: DiscoveryRelay | None = None  # without one, the children look for each other
    namespaces: Mapping[str, int] = field(default_factory=dict)  # descriptors by name of the process; else that of ours
    options: Mapping[str, Sequence[str]] = field(default_factory=dict)  # more of them, by name of the process
    ends_hung: bool = False  # whether processes that have hung are ended
    escalation: Sequence[tuple[signal.Signals, float]] = ESCALATION
    late: float = LATE
    hung_timeout: float = HUNG
    channel: Child | None = None  # carries the packets of the others; not one of ``children``: it has no part to do
    _lifeline: tuple[int, int] = field(default=(-1, -1), init=False)
    _status_files: list[Path] = field(default_factory=list, init=False)  # in the order of the starts, restarts included
    _checked: float = field(default=0.0, init=False)  # for processes that have hung [s of the monotonic clock]
    _over_since: float | None = field(default=None, init=False)  # [s of the monotonic clock]
    _control: socket.socket | None = field(default=None, init=False)  # of the channel, which ends when it is closed

    def start(self, processes: Sequence[ProcessSpec]) -> None:
        """Start all processes."""
        self._lifeline = os.pipe()
        for first in range(0, len(processes), AT_ONCE):
            self.children += self._start([(spec, 1) for spec in processes[first : first + AT_ONCE]])

    def start_channel(self) -> socket.socket:
        """Start the process of a channel, before all others; the socket at which it waits for ``hand_over``."""
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            spec = ProcessSpec(CHANNEL, (CHANNEL, "--control", str(theirs.fileno())))
            (self.channel,) = self._start([(spec, 1)])
        return self._control

    @property
    def channel_status(self) -> Path:
        """The file to which the channel writes what it did."""
        return self.logs / STATUS_FOLDER / f"{CHANNEL}.1.json"

    def restart(self, child: Child) -> None:
        """Start a process that has ended again; the new child takes its place in ``children``."""
        place = self.children.index(child)
        self.children[place : place + 1] = self._start([(child.spec, child.number + 1)])

    def _start(self, specs: Sequence[tuple[ProcessSpec, int]]) -> list[Child]:
        """Start processes; the numbers count the starts of each."""
        (self.logs / STATUS_FOLDER).mkdir(exist_ok=True)
        with contextlib.ExitStack() as stack:
            logs = [stack.enter_context(self._log(spec).open("ab")) for spec, _ in specs]
            starts = [self._node_start(*each, log.fileno()) for each, log in zip(specs, logs, strict=True)]
            processes: list[Process] = []
            if self.fork_server is not None:
                processes += self.fork_server.fork_nodes(starts)
            processes += [self._spawn(start) for start in starts[len(processes) :]]
        return [
            Child(spec, process, self._log(spec), number)
            for (spec, number), process in zip(specs, processes, strict=True)
        ]

    def _log(self, spec: ProcessSpec) -> Path:
        return self.logs / f"{spec.name}.log"

    def _node_start(self, spec: ProcessSpec, number: int, output: int) -> NodeStart:
        if spec.name == CHANNEL:
            *command, option, control = spec.arguments
            return NodeStart(command, {option: int(control)}, output, None)
        status_file = self.logs / STATUS_FOLDER / f"{spec.name}.{number}.json"
        self._status_files.append(status_file)
        arguments = [*spec.arguments, "--status-file", str(status_file), *self.options.get(spec.name, ())]
        if spec.name == SWITCHER:
            arguments += ["--steps", str(self.logs / STEPS), "--clocks", str(self.logs / CLOCKS)]
        descriptors = {"--lifeline": self._lifeline[0]}
        if self.relay is not None:
            descriptors["--introduction"] = self.relay.descriptor
        if spec.name in self.namespaces:
            descriptors["--namespace"] = self.namespaces[spec.name]
        return NodeStart(arguments, descriptors, output, self.cores.get(spec.name))

    def _spawn(self, node: NodeStart) -> Process:
        """Start a process that is not forked."""
        options = [word for option, number in node.descriptors.items() for word in (option, str(number))]
        process = programs.start(
            [sys.executable, "-m", "msg_agents", *node.arguments, *options],
            self.environment,
            stdout=node.output,
            stderr=subprocess.STDOUT,
            pass_fds=list(node.descriptors.values()),
            start_new_session=True,
        )
        if node.core is not None:
            pin_to_core(process.pid, node.core)
        return process

    def read_status(self) -> None:
        """Read what the switcher has reported, and note agents that have ended too early: their code may end Python."""
        self.steps = read_steps(self.logs / STEPS) or self.steps
        if self.channel and CHANNEL_SILENCE < self.channel.status_age < math.inf and self.channel.running:
            self.channel.end_reason = f"no report for {CHANNEL_SILENCE:g} s, as if it was stopped"
            self.channel.process.send_signal(signal.SIGKILL)
        if self.ends_hung and time.monotonic() >= self._checked + CHECK_PERIOD:
            self._checked = time.monotonic()
            for child in self.running:
                if words := child.detector.update(self.hung_timeout):  # the others would wait for it for ever
                    child.end_reason = f"{words} (stacks in log/{child.log.name})"
                    self._end([child], AFTER_HANG)
        switching = any(child.running for child in self.children if child.spec.name == SWITCHER)
        for child in self.children:
            if not self.steps or not switching or not child.spec.agents or child.process.poll() != 0:
                continue
            child.ended = child.ended or time.monotonic()
            behind = min(self.steps[agent] for agent in child.spec.agents) < self.last_step
            child.early = behind and time.monotonic() > child.ended + EARLY

    def dismiss_late(self) -> list[str]:
        """Interrupt processes that have not left long after the switcher; the names of those interrupted now."""
        # The middleware may not have given them the end of the run; one that was stopped is not given it any more.
        if not any(child.spec.name == SWITCHER and child.ended_well for child in self.children):
            return []
        self._over_since = self._over_since or time.monotonic()
        late = [child for child in self.awaited if not child.dismissed]
        if not late or time.monotonic() < self._over_since + self.late:
            return []
        for child in late:
            child.dismissed = True
            child.process.send_signal(signal.SIGINT)
        self._end([child for child in late if child.spec.name != RECORDER])  # a recorder may need time for its bag
        return [child.spec.name for child in late]

    @property
    def by_node(self) -> dict[str, Process]:
        """The newest process of every node."""
        return {node: child.process for child in self.children for node in child.spec.nodes}

    @property
    def pids(self) -> dict[int, int]:
        """PID of the process of every agent (from 0) of this host."""
        return {agent: child.process.pid for child in self.running for agent in child.spec.agents}

    @property
    def running(self) -> list[Child]:
        """Children that have not ended."""
        return [child for child in self.children if child.running]

    def status(self) -> StatusSummary:
        """What the nodes have refused, and what they wait for."""
        return read_status_files(self._status_files)

    def clocks(self) -> tuple[list[dict[str, Any]] | None, str | None]:
        """How far the clocks of several hosts are apart (None: not compared), and a warning."""
        report = read_report(self.logs / CLOCKS) or {}
        return report.get("offsets"), report.get("warning")

    def stall_causes(self, names: Sequence[str] | None) -> str:
        """Causes of a stall, as far as they are known; a silent process is stopped, or waits for one that is."""
        words = [f"{node}: {message}" for node, message in sorted(self.status().waiting.items())]
        stopped = {child.spec.name: child.process.pid for child in self.running if child.stopped}
        if stopped:
            listed = ", ".join(f"{name} (PID {pid})" for name, pid in stopped.items())
            words.append(f"stopped, and waited for: {listed}")
        silent = [child.spec.name for child in self.silent if child.spec.name not in stopped]
        if silent:
            words.append("no report from " + ", ".join(silent))
        if not words and self.steps:  # the processes that know are on another host
            last = min(self.steps)
            awaited = ", ".join(child.spec.name for child in self.awaited)
            slowest = f"slowest: agent {self.steps.index(last) + 1}, at step {last}"
            words.append(slowest if last < self.last_step else f"waiting for the end of {awaited}")
        return with_names("; ".join(words), names) or "cause unknown"

    @property
    def silent(self) -> list[Child]:
        """Running children that have not written their status file lately."""
        running = self.running + ([self.channel] if self.channel and self.channel.running else [])
        return [child for child in running if child.status_age > SILENCE]

    @property
    def starting_again(self) -> list[Child]:
        """Restarted children that have not found all others yet: they write no status file before."""
        return [child for child in self.running if child.number > 1 and child.status_age == math.inf]

    @property
    def over(self) -> bool:
        """Whether all have done their part: no process leaves before, and the switcher only after it has said so."""
        names = {child.spec.name for child in self.children}
        ended = {child.spec.name for child in self.children if child.ended_well}
        if SWITCHER not in names:  # it is on another host
            return bool(ended)
        return SWITCHER in ended or (bool(ended) and names - ended == {SWITCHER})

    @property
    def awaited(self) -> list[Child]:
        """Running children that have something to do; one that was restarted after the end has not."""
        return [child for child in self.running if child.number == 1 or not self.over]

    @property
    def failures(self) -> list[Child]:
        """Children that failed; after the end of the run, only the recorder can still fail."""
        failed = [child for child in (self.channel, *self.children) if child and child.failure]
        if failed and self.over:
            return [child for child in failed if child.spec.name == RECORDER]
        return failed

    def drain(self) -> None:
        """Wait, for a few seconds at most, until the agents have sent the recorder what they have collected for it."""
        # They do so every half second, and write their status every second.
        until = time.monotonic() + DRAIN_TIME
        begun = time.monotonic() + SEND_PERIOD
        while time.monotonic() < until and any(
            child.spec.agents and child.status_age > time.monotonic() - begun for child in self.running
        ):
            time.sleep(POLL)

    def stop(self) -> None:
        """End all: first the agents and the switcher, so that the recorder gets all that they sent."""
        self._end([child for child in self.children if child.spec.name != RECORDER])
        self._end([child for child in self.children if child.spec.name == RECORDER])
        if self.channel and self._control:
            self._control.close()
            self._end([self.channel])

    def _end(self, children: Sequence[Child], escalation: Sequence[tuple[signal.Signals, float]] | None = None) -> None:
        for number, timeout in escalation or self.escalation:
            for child in children:
                if child.running:
                    child.process.send_signal(number)
            deadline = time.monotonic() + timeout
            while any(child.running for child in children) and time.monotonic() < deadline:
                time.sleep(POLL)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for descriptor in self._lifeline:
            with contextlib.suppress(OSError):
                os.close(descriptor)
