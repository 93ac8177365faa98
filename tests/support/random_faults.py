"""Random faults for the networks of ``random_networks``: killed and stopped processes, and what the run may do then."""

import random
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from random_networks import random_document

from msg_agents.environment import RESTARTS
from msg_agents.process_layout import RECORDER, SWITCHER, Process
from msg_agents.run.result import RunResult
from msg_agents.run.runner import run_network
from msg_agents.watch.panel import View
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.topics import agent_node_name
from msg_analysis.twin.check import check

LATEST = 0.7  # of the steps: later, the run might be over before the fault
LONGEST_WAIT = 0.1  # s between a step and the fault: steps are reported ten times a second
LONGEST_STOP = 1.5  # s
ONE_ENDS_IN = 8  # networks
TIMEOUT = 60.0  # s without a step or a restart: three leases of the middleware, or twice the time of discovery
CONSEQUENCES = re.compile(r"\S+: killed by SIGKILL|the bag was salvaged: |nothing was recorded: |last recorded step: ")


@dataclass(frozen=True, slots=True)
class Fault:
    """One process is killed, or stopped for a while."""

    node: str  # one of those of the process
    step: int  # that all agents have reached before; -1: the processes have been started
    wait: float  # s after that
    stopped: float | None = None  # s between SIGSTOP and SIGCONT; None: SIGKILL

    @property
    def kills(self) -> bool:
        return self.stopped is None


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """The faults of one run, and how many restarts it may make."""

    faults: tuple[Fault, ...]
    restarts: int

    @property
    def survivable(self) -> bool:
        """Whether the run is complete after all of them, as docs/faults.md says."""
        killed = [fault.node for fault in self.faults if fault.kills]
        return RECORDER not in killed and len(killed) <= self.restarts


def plan_faults(seed: int, agents: int, steps: int) -> FaultPlan:
    """The faults of the network of a seed."""
    draw = random.Random(f"faults {seed}")
    peers = [SWITCHER, *(agent_node_name(agent) for agent in range(agents))]
    kills = draw.choices(range(RESTARTS + 1), [1, 3, 3, 2])[0]
    victims: list[tuple[str, float | None]] = [(draw.choice(peers), None) for _ in range(kills)]
    for _ in range(draw.choices(range(3), [2, 2, 1])[0]):
        victims.append((draw.choice([*peers, RECORDER]), draw.uniform(0.05, LONGEST_STOP)))
    restarts = RESTARTS
    if draw.randrange(ONE_ENDS_IN) == 0:  # the run cannot go on
        if draw.random() < 0.5:
            victims.append((RECORDER, None))
        else:
            victims.append((draw.choice(peers), None))
            restarts = kills
    faults = [Fault(node, _moment(draw, steps), draw.uniform(0.0, LONGEST_WAIT), stop) for node, stop in victims]
    return FaultPlan(tuple(sorted(faults, key=lambda fault: fault.step)), restarts)


def _moment(draw: random.Random, steps: int) -> int:
    return -1 if draw.random() < 0.15 else draw.randint(0, round(LATEST * steps))


class FaultInjection(View):
    """Kills, stops and continues processes of the run that it views, and ends a run that makes no step any more."""

    def __init__(self, plan: FaultPlan, timeout: float = TIMEOUT) -> None:
        super().__init__(lambda _: None, lambda _: None)
        self._pending = list(plan.faults)
        self._timeout = timeout
        self._processes: Mapping[str, Process] = {}
        self._reached: dict[int, float] = {}  # when each step of the plan was seen to have been reached
        self._stopped: list[tuple[float, Process]] = []  # until when
        self._newest: list[int] = []
        self._moved = time.monotonic()
        self._note = ""  # the last one
        self.delivered: list[Fault] = []  # the others found their process ended
        self.standstill: str | None = None  # why the run was ended

    def started(self, processes: Mapping[str, Process]) -> None:
        self._processes = processes
        self._moved = time.monotonic()

    def note(self, line: str) -> None:
        self._note = f": {line}"

    def look(self, steps: Sequence[int]) -> None:
        now, reached = time.monotonic(), min(steps, default=-1)
        self._go_on(lambda until: until <= now)
        for fault in list(self._pending):
            if fault.step <= reached and now >= self._reached.setdefault(fault.step, now) + fault.wait:
                self._pending.remove(fault)
                self._deliver(fault, now)
        if list(steps) != self._newest:
            self._newest, self._moved = list(steps), now
        if now > self._moved + self._timeout and self.standstill is None:
            self.standstill = f"ended after {self._timeout:g} s without a step{self._note}"
            signal.raise_signal(signal.SIGINT)  # so that the run ends in order, and its logs are kept

    def end(self) -> None:
        """Continue what is stopped: it could not end."""
        self._go_on(lambda _: True)

    def _deliver(self, fault: Fault, now: float) -> None:
        process = self._processes[fault.node]
        if process.poll() is not None:
            return
        self.delivered.append(fault)
        if fault.stopped is None:
            process.send_signal(signal.SIGKILL)
        else:
            process.send_signal(signal.SIGSTOP)
            self._stopped.append((now + fault.stopped, process))

    def _go_on(self, due: Callable[[float], bool]) -> None:
        for until, process in self._stopped:
            if due(until):
                process.send_signal(signal.SIGCONT)
        self._stopped = [(until, process) for until, process in self._stopped if not due(until)]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a run went as it had to: equal and complete, or ended by its faults with an equal part."""

    status: Literal["equal", "ended", "differs", "failed"]
    text: str
    compared: int = 0  # states


def judge(result: RunResult, plan: FaultPlan, standstill: str | None = None) -> Verdict:
    """Compare a run with its twin, and its end with what the faults allow that it has met."""
    trajectory = result.trajectory
    compared = missing = twice = 0
    if trajectory is not None:
        outcome = check(trajectory)
        compared, missing, twice = outcome.compared, outcome.missing, trajectory.completeness.duplicates
        if outcome.difference:
            return Verdict("differs", outcome.difference, compared)
    if standstill is not None:
        return Verdict("failed", standstill, compared)
    if wrong := _unexpected_restart(result.restarts, plan.faults):
        return Verdict("failed", wrong, compared)
    if result.failures:
        caused = not plan.survivable and all(CONSEQUENCES.match(line) for line in result.failures)
        return Verdict("ended" if caused else "failed", result.failures[0], compared)
    if missing or twice:
        return Verdict("failed", f"{missing} states or graphs are missing, {twice} are there twice", compared)
    return Verdict("equal", f"{compared} states", compared)


def _unexpected_restart(restarts: Sequence[str], faults: Sequence[Fault]) -> str | None:
    """The first restart that no fault is the cause of."""
    kills = sum(fault.kills for fault in faults)
    crashes = [line for line in restarts if ": killed by SIGKILL" not in line]
    extra = crashes or restarts[kills:]
    return f"restarted without a fault: {extra[0]}" if extra else None


def run_random_network(seed: int, out: Path) -> tuple[RunResult, FaultPlan, Verdict]:
    """Run the network of a seed with its faults; the plan has those that met a running process."""
    experiment = Experiment.parse(random_document(seed))
    plan = plan_faults(seed, experiment.agents, experiment.steps)
    injection = FaultInjection(plan)
    result = run_network(experiment, out, restarts=plan.restarts, view=injection)
    met = replace(plan, faults=tuple(injection.delivered))
    return result, met, judge(result, met, injection.standstill)
