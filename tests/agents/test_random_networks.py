# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Random networks and random faults of the tests: valid, of every kind, and found when they go wrong."""

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

SEEDS = range(300)


@pytest.fixture(scope="module")
def documents() -> list[dict[str, Any]]:
    return [random_document(seed) for seed in SEEDS]


def test_every_one_can_be_run(documents: list[dict[str, Any]]) -> None:
    """In lockstep, as the loader of experiment files says."""
    for document in documents:
        experiment = Experiment.parse(json.loads(json.dumps(document)))
        experiment.require_available()
        assert experiment.run.pace == "lockstep"
        assert experiment.agents == document["agents"]


def test_every_kind_is_there(documents: list[dict[str, Any]]) -> None:
    found = {word for document in documents for word in kinds(document)}
    assert found == {
        *("consensus", "tracking", "continuous", "discrete", "inf", "finite"),
        *("path", "cycle", "edges", "arcs", "star", "complete", "grid"),
        *("no switching", "generator", "rates", "transition", "from stationary", "from a graph"),
        *("number", "list", "matrix", "by graph", "broadcast", "link", "loss", "delay", "burst", "on_loss"),
        *("start stationary", "start zero", "start list", "auto", "one_per_agent", "some processes"),
    }
    assert {document["agents"] for document in documents} == set(range(2, MOST_AGENTS + 1))
    assert {len(document["graphs"]) for document in documents} == set(range(1, len(GRAPH_NAMES) + 1))


def kinds(document: dict[str, Any]) -> Iterator[str]:
    """What an experiment has, in words."""
    yield document["problem"]
    yield document["time"]
    if "leaders" in document:
        yield "inf" if document["leaders"]["gain"] == "inf" else "finite"
    for graph in document["graphs"].values():
        yield from graph
    switching = document.get("switching")
    if switching is None:
        yield "no switching"
    else:
        yield from switching.keys() & {"generator", "rates", "transition"}
        yield "from stationary" if switching["initial"] == "stationary" else "from a graph"
    noise = dict(document["noise"])
    process = noise.pop("process")
    yield "by graph" if isinstance(process, dict) else shape(process)
    yield from noise
    start, processes = document["run"]["start"], document["run"]["processes"]
    yield f"start {start if isinstance(start, str) else 'list'}"
    yield processes if isinstance(processes, str) else "some processes"


def shape(gain: Any) -> str:
    if not isinstance(gain, list):
        return "number"
    return "matrix" if isinstance(gain[0], list) else "list"


def test_some_are_connected_only_in_all_graphs_together() -> None:
    """Then an error in the path of the graphs is sure to be one in the states."""
    apart = 0
    for seed in range(100):
        experiment = Experiment.parse(random_document(seed))
        graphs = [nx.from_numpy_array(graph.adjacency != 0, create_using=nx.DiGraph) for graph in experiment.graph_list]
        assert nx.is_weakly_connected(nx.compose_all(graphs))
        apart += not any(nx.is_weakly_connected(graph) for graph in graphs)
    assert apart > 20


AGENTS, STEPS = 3, 1000
NODES = {"agent_1", "agent_2", "agent_3", "switcher", "recorder"}
KILL, STOP = Fault("agent_2", 10, 0.0), Fault("agent_1", 20, 0.0, stopped=1.0)
KILL_RECORDER = Fault("recorder", 10, 0.0)
KILLED = "agent_2: killed by SIGKILL after step 12, started again"
SALVAGED = "the bag was salvaged: 100 messages kept"
LAST = "last recorded step: agent 1: 40, agent 2: 41, agent 3: 40"

Processes = dict[str, subprocess.Popen[bytes]]


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


def stopped(process: subprocess.Popen[bytes]) -> bool:
    return state_of(process.pid) == "T"


def test_a_kill_comes_when_all_agents_have_made_its_step(processes: Processes) -> None:
    late, early = Fault("agent_2", 7, 0.0), Fault("agent_1", 5, 0.0)
    made = injection(processes, early, late)
    made.look([])
    made.look([4, 9])
    assert made.delivered == []
    made.look([6, 9])
    assert made.delivered == [early]
    assert processes["agent_1"].wait() == -signal.SIGKILL
    made.look([7, 9])
    assert made.delivered == [early, late]
    assert processes["agent_2"].wait() == -signal.SIGKILL
    assert processes["recorder"].poll() is None


def test_a_fault_before_the_first_step(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", -1, 0.0))
    made.look([])
    assert processes["agent_1"].wait() == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: no /proc")
def test_a_stopped_process_goes_on(processes: Processes) -> None:
    """After its time, or as soon as the run is over."""
    made = injection(processes, Fault("recorder", 0, 0.0, stopped=600.0), Fault("agent_1", 0, 0.0, stopped=0.0))
    made.look([0, 0])
    for name in ("recorder", "agent_1"):
        wait_for(lambda name=name: stopped(processes[name]))
    made.look([1, 1])
    wait_for(lambda: not stopped(processes["agent_1"]))
    assert stopped(processes["recorder"])
    made.end()
    wait_for(lambda: not stopped(processes["recorder"]))


def test_a_process_that_has_ended_meets_no_fault(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", 0, 0.0), Fault("agent_2", 0, 0.0, stopped=1.0))
    for name in ("agent_1", "agent_2"):
        processes[name].kill()
        processes[name].wait()
    made.look([3, 3])
    assert made.delivered == []


def test_the_process_of_a_restarted_node(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", 2, 0.0))
    processes["agent_1"].kill()
    processes["agent_1"].wait()
    made.started(processes | {"agent_1": processes["recorder"]})
    made.look([2, 2])
    assert processes["recorder"].wait() == -signal.SIGKILL


def test_a_run_that_stands_still_is_ended_once(processes: Processes) -> None:
    made = FaultInjection(FaultPlan((), 3), timeout=0.0)
    made.started(processes)
    made.note("no step for 5 s: cause unknown")
    with Interruption() as interruption:
        made.look([2, 3])
        assert interruption.caught is None
        wait_for(lambda: made.look([2, 3]) or made.standstill)
        assert interruption.caught == signal.SIGINT
        interruption.caught = None
        made.look([2, 3])
        assert interruption.caught is None
    assert made.standstill == "ended after 0 s without a step: no step for 5 s: cause unknown"


def plan(*faults: Fault, restarts: int = 3) -> FaultPlan:
    return FaultPlan(faults, restarts)


def kill(node: str) -> Fault:
    return Fault(node, 0, 0.0)


def test_all_nodes_and_all_times() -> None:
    faults = [fault for seed in range(300) for fault in plan_faults(seed, AGENTS, STEPS).faults]
    for kills in (False, True):
        assert {fault.node for fault in faults if fault.kills == kills} == NODES
    assert min(fault.step for fault in faults) == -1
    assert 600 < max(fault.step for fault in faults) < STEPS
    assert min(fault.stopped for fault in faults if fault.stopped is not None) > 0


def test_most_runs_go_on() -> None:
    plans = [plan_faults(seed, AGENTS, STEPS) for seed in range(300)]
    ends = [each for each in plans if not each.survivable]
    assert 20 < len(ends) < 60
    assert {each.restarts for each in plans if each.survivable} == {RESTARTS}
    assert {sum(fault.kills for fault in each.faults) for each in plans if each.survivable} == set(range(RESTARTS + 1))
    for each in ends:
        killed = [fault.node for fault in each.faults if fault.kills]
        assert killed.count("recorder") == 1 or len(killed) == each.restarts + 1


def test_what_a_run_survives() -> None:
    """As docs/faults.md says: as many killed agents and switchers as there are restarts, and no killed recorder."""
    assert plan().survivable
    assert plan(kill("agent_1"), kill("switcher"), kill("agent_1")).survivable
    assert plan(Fault("recorder", 0, 0.0, stopped=1.0)).survivable
    assert not plan(kill("recorder")).survivable
    assert plan(kill("agent_1"), restarts=1).survivable
    assert not plan(kill("agent_1"), restarts=0).survivable
    assert not plan(*(kill("switcher") for _ in range(4))).survivable


def simulated(seed: int) -> Run:
    graphs = {"line": {"path": [1, 2, 3]}, "pair": {"path": [1, 2]}}
    switching = {"generator": [[-2, 2], [2, -2]]}
    return simulate(experiment(graphs=graphs, switching=switching, run={"duration": 5, "start": "zero", "seed": seed}))


@pytest.fixture(scope="module")
def twin() -> Run:
    return simulated(0)


def run(trajectory: Run, **changes: Any) -> RunResult:
    return RunResult(trajectory.record.experiment, None, trajectory=trajectory, **changes)


def test_equal(twin: Run) -> None:
    assert judge(run(twin), plan()) == Verdict("equal", "303 states", 303)
    assert judge(run(twin, restarts=[KILLED]), plan(KILL, STOP)).status == "equal"


def test_one_bit(twin: Run) -> None:
    """In the last place of one number; whatever else has happened."""
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


def test_another_seed(twin: Run) -> None:
    other = replace(simulated(1), record=twin.record)
    assert judge(run(other), plan(KILL)).status == "differs"


def test_missing_and_twice(twin: Run) -> None:
    count = twin.completeness
    for found in (replace(count, missing=1), replace(count, missing_modes=1), replace(count, duplicates=1)):
        verdict = judge(run(replace(twin, completeness=found)), plan(KILL))
        assert verdict.status == "failed", found


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
        assert verdict.status == "failed"
        assert verdict.text == f"restarted without a fault: {restarts[-1]}"


def test_a_standstill(twin: Run) -> None:
    """Its bag was not read."""
    result = RunResult(twin.record.experiment, None, interrupted_by=2, failures=["stopped by Ctrl-C at step 3"])
    words = "ended after 60 s without a step"
    assert judge(result, plan(KILL), words) == Verdict("failed", words)
