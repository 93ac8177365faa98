# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Random networks and random faults of the tests: what can be run, what it meets, and what is wrong with it then."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np
import pytest
from networks import experiment
from random_faults import Fault, FaultInjection, FaultPlan, Verdict, judge, plan_faults
from random_networks import GRAPH_NAMES, MOST_AGENTS, random_document
from waiting import state_of, wait_for

from msg_agents.environment import RESTARTS
from msg_agents.run.result import RunResult
from msg_agents.terminal import Interruption
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.twin.simulate import simulate

KILL, STOP = Fault("agent_2", 10, 0.0), Fault("agent_1", 20, 0.0, stopped=1.0)
KILL_RECORDER = Fault("recorder", 10, 0.0)
KILLED = "agent_2: killed by SIGKILL after step 12, started again"
SALVAGED = "the bag was salvaged: 100 messages kept"
LAST = "last recorded step: agent 1: 40, agent 2: 41, agent 3: 40"

Processes = dict[str, subprocess.Popen[bytes]]


def test_every_network_can_be_run() -> None:
    """In lockstep, as the loader of experiment files says; some are connected only in all graphs together."""
    apart, agents, graphs = 0, set(), set()
    for seed in range(300):
        document = random_document(seed)
        what = Experiment.parse(json.loads(json.dumps(document)))
        what.require_available()
        assert what.run.pace == "lockstep"
        assert what.agents == document["agents"]
        there = [nx.from_numpy_array(graph.adjacency != 0, create_using=nx.DiGraph) for graph in what.graph_list]
        assert nx.is_weakly_connected(nx.compose_all(there))
        apart += not any(nx.is_weakly_connected(graph) for graph in there)
        agents.add(what.agents)
        graphs.add(len(there))
    assert apart > 60
    assert agents == set(range(2, MOST_AGENTS + 1))
    assert graphs == set(range(1, len(GRAPH_NAMES) + 1))


def test_faults_of_all_nodes_at_all_times() -> None:
    """As docs/faults.md says: a run survives as many killed agents and switchers as it has restarts, no recorder."""
    plans = [plan_faults(seed, 3, 1000) for seed in range(300)]
    faults = [fault for plan in plans for fault in plan.faults]
    nodes = {"agent_1", "agent_2", "agent_3", "switcher", "recorder"}
    for kills in (False, True):
        assert {fault.node for fault in faults if fault.kills == kills} == nodes
    assert min(fault.step for fault in faults) == -1
    assert 600 < max(fault.step for fault in faults) < 1000
    for plan in plans:
        killed = [fault.node for fault in plan.faults if fault.kills]
        assert plan.survivable == ("recorder" not in killed and len(killed) <= plan.restarts)
    assert {plan.restarts for plan in plans if plan.survivable} == {RESTARTS}
    assert 20 < sum(not plan.survivable for plan in plans) < 60


@pytest.fixture
def processes() -> Iterator[Processes]:
    """Of two agents and a recorder, which do nothing."""
    started = {name: subprocess.Popen(["sleep", "600"]) for name in ("agent_1", "agent_2", "recorder")}
    yield started
    for process in started.values():
        process.kill()
        process.wait()


def injection(processes: Processes, *faults: Fault) -> FaultInjection:
    made = FaultInjection(FaultPlan(faults, 3))
    made.started(processes)
    return made


def test_a_kill_comes_when_all_agents_have_made_its_step(processes: Processes) -> None:
    """To the process that is the node's then; one that has ended meets no fault."""
    late, early = Fault("agent_2", 7, 0.0), Fault("agent_1", 5, 0.0)
    made = injection(processes, early, late, Fault("agent_1", 8, 0.0))
    made.look([4, 9])
    assert made.delivered == []
    made.look([6, 9])
    assert made.delivered == [early]
    assert processes["agent_1"].wait() == -signal.SIGKILL
    made.started(processes | {"agent_2": processes["recorder"]})
    made.look([8, 9])
    assert made.delivered == [early, late]
    assert processes["recorder"].wait() == -signal.SIGKILL
    assert processes["agent_2"].poll() is None


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: no /proc")
def test_a_stopped_process_goes_on(processes: Processes) -> None:
    """After its time, or as soon as the run is over."""

    def stopped(name: str) -> bool:
        return state_of(processes[name].pid) == "T"

    made = injection(processes, Fault("recorder", 0, 0.0, stopped=600.0), Fault("agent_1", 0, 0.0, stopped=0.0))
    made.look([0, 0])
    wait_for(lambda: stopped("recorder") and stopped("agent_1"))
    made.look([1, 1])
    wait_for(lambda: not stopped("agent_1"))
    assert stopped("recorder")
    made.end()
    wait_for(lambda: not stopped("recorder"))


def test_a_run_that_stalls_is_ended_once(processes: Processes) -> None:
    made = FaultInjection(FaultPlan((), 3), timeout=0.0)
    made.started(processes)
    made.note("no step for 5 s: cause unknown")
    with Interruption() as interruption:
        made.look([2, 3])
        assert interruption.caught is None
        wait_for(lambda: made.look([2, 3]) or made.standstill)
        assert interruption.take() == signal.SIGINT
        made.look([2, 3])
        assert interruption.caught is None
    assert made.standstill == "ended after 0 s without a step: no step for 5 s: cause unknown"


def plan(*faults: Fault, restarts: int = 3) -> FaultPlan:
    return FaultPlan(faults, restarts)


def simulated(seed: int) -> Run:
    graphs = {"line": {"path": [1, 2, 3]}, "pair": {"path": [1, 2]}}
    switching = {"generator": [[-2, 2], [2, -2]]}
    run = {"duration": 5, "start": "zero", "seed": seed}
    return simulate(experiment(3, graphs=graphs, switching=switching, run=run))


@pytest.fixture(scope="module")
def twin() -> Run:
    return simulated(0)


def run(trajectory: Run, **changes: Any) -> RunResult:
    return RunResult(trajectory.record.experiment, None, trajectory=trajectory, **changes)


def test_one_bit(twin: Run) -> None:
    """In the last place of one number; whatever else has happened. Another seed, too."""
    assert judge(run(twin), plan()) == Verdict("equal", "303 states", 303)
    assert judge(run(twin, restarts=[KILLED]), plan(KILL, STOP)).status == "equal"
    states = twin.states.copy()
    states[57, 1, 0] = np.nextafter(states[57, 1, 0], np.inf)
    wrong = replace(twin, states=states)
    for verdict in (
        judge(run(wrong), plan()),
        judge(run(wrong, failures=["recorder: killed by SIGKILL", SALVAGED]), plan(KILL_RECORDER)),
        judge(run(wrong), plan(), "ended after 60 s without a step"),
    ):
        assert verdict.status == "differs"
        assert verdict.text.startswith("agent 2 at step 57, replica 1: logged ")
    assert judge(run(replace(simulated(1), record=twin.record)), plan(KILL)).status == "differs"


def test_missing_and_twice(twin: Run) -> None:
    count = twin.completeness
    for found in (replace(count, missing=1), replace(count, missing_modes=1), replace(count, duplicates=1)):
        assert judge(run(replace(twin, completeness=found)), plan(KILL)).status == "failed", found


@pytest.mark.parametrize(
    ("faults", "restarts", "failures"),
    [
        ([KILL_RECORDER], 3, ["recorder: killed by SIGKILL", SALVAGED, LAST]),
        ([KILL_RECORDER, STOP], 3, ["recorder: killed by SIGKILL", "nothing was recorded: the run ended before"]),
        ([KILL], 0, ["agent_2: killed by SIGKILL: a last word", LAST]),
        ([KILL] * 4, 3, ["agents_2_to_3: killed by SIGKILL. Not started again: all restarts are used up", LAST]),
    ],
)
def test_ended_by_its_faults(twin: Run, faults: list[Fault], restarts: int, failures: list[str]) -> None:
    """But not without them, or if it could have gone on."""
    short = replace(twin, completeness=replace(twin.completeness, missing=200))
    ended = run(short, failures=failures)
    assert judge(ended, plan(*faults, restarts=restarts)) == Verdict("ended", failures[0], 303)
    assert judge(ended, plan(STOP, restarts=restarts)) == Verdict("failed", failures[0], 303)
    assert judge(ended, plan(KILL, restarts=1)).status == "failed"
    worse = run(short, failures=[*failures, "agent_1: exit code 1: MemoryError"])
    assert judge(worse, plan(*faults, restarts=restarts)).status == "failed"


def test_restarts_without_a_fault(twin: Run) -> None:
    crash = "agent_2: exit code 1 (KeyError: 3), started again"
    for restarts, faults in (([crash], [KILL]), ([KILLED, crash], [KILL, KILL]), ([KILLED, KILLED], [KILL, STOP])):
        verdict = judge(run(twin, restarts=restarts), plan(*faults))
        assert verdict == Verdict("failed", f"restarted without a fault: {restarts[-1]}", verdict.compared)


def test_a_standstill(twin: Run) -> None:
    """Its bag was not read."""
    result = RunResult(twin.record.experiment, None, interrupted_by=2, failures=["stopped by Ctrl-C at step 3"])
    words = "ended after 60 s without a step"
    assert judge(result, plan(KILL), words) == Verdict("failed", words)
