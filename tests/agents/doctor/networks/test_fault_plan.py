"""Plans of faults: only what the documentation says the end of."""

from __future__ import annotations

from msg_agents.doctor.networks.fault_plan import Fault, FaultPlan, plan_faults
from msg_agents.processes.environment import RESTARTS

AGENTS, STEPS = 3, 1000
NODES = {"agent_1", "agent_2", "agent_3", "switcher", "recorder"}


def plan(*faults: Fault, restarts: int = 3) -> FaultPlan:
    return FaultPlan(faults, restarts)


def kill(node: str) -> Fault:
    return Fault(node, 0, 0.0)


def test_the_same_for_a_seed() -> None:
    plans = [plan_faults(seed, AGENTS, STEPS) for seed in range(50)]
    assert plans == [plan_faults(seed, AGENTS, STEPS) for seed in range(50)]
    assert len(set(plans)) > 40


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
