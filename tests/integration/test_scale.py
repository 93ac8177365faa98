"""Large networks: many processes, and many agents in a few."""

import contextlib
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from joining_node import watched_endpoints
from networks import assert_equal_to_twin

from msg_agents.run.result import read_steps
from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check


def grid(rows: int, columns: int) -> dict[str, Any]:
    """Agents on a grid, so that processes hear processes that are not next to them, and on a path along its rows."""
    return {"graphs": {"grid": {"grid": [rows, columns]}, "path": {"path": list(range(1, rows * columns + 1))}}}


@pytest.mark.parametrize(
    ("rows", "columns", "processes"), [(5, 8, "one_per_agent"), (10, 10, 4)], ids=["40 in 40", "100 in 4"]
)
def test_complete_and_equal_to_the_twin(network: Any, rows: int, columns: int, processes: Any) -> None:
    agents = rows * columns
    run = {"duration": 2, "start": "zero", "processes": processes}
    result = network.run(network.experiment(**grid(rows, columns), run=run))
    assert_equal_to_twin(result.trajectory)
    assert result.trajectory.completeness.expected == agents * 41


def complete(agents: int) -> dict[str, Any]:
    """Everybody hears everybody, or those on a ring."""
    return {"agents": agents, "graphs": {"all": {"complete": True}, "ring": {"cycle": [*range(1, agents + 1)]}}}


def first_third_hears_all(agents: int) -> dict[str, Any]:
    """Of three processes, the first hears the agents of both others, and they hear only those of the first."""
    third = agents // 3
    links = [[i, j] for i in range(1, third + 1) for j in range(i + 1, agents + 1)]
    return {"agents": agents, "graphs": {"third": {"edges": links}, "path": {"path": [*range(1, third + 1)]}}}


def cores_of(pid: int) -> set[int]:
    """Cores that any thread of a process may run on."""
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        return set.union(*(os.sched_getaffinity(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()))
    return set()


def assert_cores(network: Any, *, pinned: bool) -> dict[int, set[int]]:
    """Each process keeps to one core, and together to all of them, or none does; the cores, by its first agent."""
    kept = {process.agent: cores_of(process.pid) for process in network.processes("agent")}
    cores = os.sched_getaffinity(0)
    assert {len(own) for own in kept.values()} == {1 if pinned else len(cores)}
    assert len(set.union(*kept.values())) == (min(len(cores), len(kept)) if pinned else len(cores))
    return kept


def back_on(network: Any, victim: Any, cores: set[int]) -> None:
    """Kill a process, and wait until the one that takes its place may run on these cores."""
    victim.kill()

    def back() -> bool:
        others = [p for p in network.processes("agent") if p.agent == victim.agent and p != victim]
        return any(cores_of(process.pid) == cores for process in others)

    network.wait_for(back, 60, "the agent on its core again")


def test_processes_of_one_agent_that_hear_all_others(network: Any) -> None:
    """Each keeps to one core, where there are more of them than cores; so does the one that comes back."""
    # Nobody waits for the planned end of the run, so it cannot be over too early.
    run = {"duration": 1000, "start": "zero", "processes": "one_per_agent", "replicas": 16}
    process = network.record(network.file(**complete(9), run=run), "--restarts", "1", "--json")
    steps = network.wait_for_steps()
    kept = assert_cores(network, pinned=2 <= len(os.sched_getaffinity(0)) <= 9)
    victim = network.processes("agent")[-1]
    back_on(network, victim, kept[victim.agent])
    before = max(read_steps(steps))
    network.wait_for(lambda: min(read_steps(steps)) > before, 60, "steps of all after that")
    process.send_signal(signal.SIGINT)
    result = network.result(process, 3)
    assert (len(result["restarts"]), result["rejected_messages"]) == (1, [])
    assert check(read_bag(result["bag"])).difference is None


@pytest.mark.parametrize(
    ("experiment", "processes", "of_batches", "of_first", "of_last"),
    [(complete(24), 5, [1, 5, 10, 15, 20], [], []), (first_third_hears_all(24), 3, [1], [*range(9, 25)], [])],
    ids=["all", "a third"],
)
def test_processes_that_hear_most_of_a_network(
    network: Any,
    domain: int,
    experiment: Any,
    processes: int,
    of_batches: list[int],
    of_first: list[int],
    of_last: list[int],
) -> None:
    """They read batches, on the node of their first agent, and no topic of single agents. None keeps to a core."""
    # A process is killed and comes back: all is there, and as the twin says.
    readers = {
        "/states": sorted(["recorder", *(f"agent_{i}" for i in of_batches)]),
        "/agent_1/state": sorted(f"agent_{i}" for i in of_first),
        "/agent_24/state": sorted(f"agent_{i}" for i in of_last),
    }
    run = {"duration": 60, "start": "zero", "processes": processes, "replicas": 16}
    wanted = {topic: [[name, "RELIABLE"] for name in names] for topic, names in readers.items()}
    with watched_endpoints(wanted, {}, domain):
        options = ("--no-pin", "--restarts", "1", "--json", "--domain", str(domain))
        process = network.record(network.file(**experiment, run=run), *options)
    network.wait_for_steps()
    kept = assert_cores(network, pinned=False)
    victim = network.processes("agent")[-1]
    back_on(network, victim, kept[victim.agent])
    result = network.completed(process)
    assert (len(result["restarts"]), result["rejected_messages"]) == (1, [])
