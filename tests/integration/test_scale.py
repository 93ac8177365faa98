"""Large networks: many processes, and many agents in a few."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from visitor import assert_endpoints

from msg_analysis.bags.reader import read_bag
from msg_analysis.twin.check import check


def grid(rows: int, columns: int) -> dict[str, Any]:
    """Agents on a grid, so that processes hear processes that are not next to them, and on a path along its rows."""
    return {"graphs": {"grid": {"grid": [rows, columns]}, "path": {"path": list(range(1, rows * columns + 1))}}}


@pytest.mark.parametrize(
    ("rows", "columns", "processes"), [(5, 8, "one_per_agent"), (10, 10, 4)], ids=["40 in 40", "100 in 4"]
)
def test_complete_and_equal_to_the_twin(network: Any, rows: int, columns: int, processes: Any) -> None:
    agents = rows * columns
    run = {"duration": 5, "start": "zero", "processes": processes}
    result = network.run(network.experiment(**grid(rows, columns), run=run))
    assert result.failures == []
    assert result.trajectory.completeness.complete
    assert result.trajectory.completeness.duplicates == 0
    outcome = check(result.trajectory)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, agents * 101)


def test_a_killed_process_of_many_agents_comes_back(network: Any) -> None:
    """What its agents had told each other directly has gone with it."""
    file = network.file(**grid(6, 5), run={"duration": 100, "start": "zero", "processes": 2, "replicas": 16})
    run = network.record(file, "--restarts", "1", "--json")
    network.wait_until_moving()
    network.processes("agent")[0].kill()
    stdout, stderr = run.communicate(timeout=110)
    result = json.loads(stdout)
    assert (len(result["restarts"]), result["failures"]) == (1, []), stderr
    outcome = check(read_bag(result["bag"]))
    assert (outcome.difference, outcome.missing) == (None, 0)


def complete(agents: int) -> dict[str, Any]:
    """Everybody hears everybody, or those on a ring."""
    return {"agents": agents, "graphs": {"all": {"complete": True}, "ring": {"cycle": [*range(1, agents + 1)]}}}


def first_third_hears_all(agents: int) -> dict[str, Any]:
    """Of three processes, the first hears the agents of both others, and they hear only those of the first."""
    third = agents // 3
    links = [[i, j] for i in range(1, third + 1) for j in range(i + 1, agents + 1)]
    return {"agents": agents, "graphs": {"third": {"edges": links}, "path": {"path": [*range(1, third + 1)]}}}


@pytest.mark.parametrize(
    ("experiment", "processes"),
    [(complete(24), 3), (first_third_hears_all(24), 3), (complete(17), "one_per_agent")],
    ids=["24 in 3", "a third", "17 in 17"],
)
def test_processes_that_hear_most_of_a_network(network: Any, experiment: Any, processes: Any) -> None:
    """A process is killed and comes back: all is there, and as the twin says."""
    run = {"duration": 30, "start": "zero", "processes": processes, "replicas": 16}
    process = network.record(network.file(**experiment, run=run), "--restarts", "1", "--json")
    network.wait_until_moving()
    network.processes("agent")[-1].kill()
    result = network.completed(process)
    assert (len(result["restarts"]), result["strangers"]) == (1, [])


@pytest.mark.parametrize(
    ("experiment", "of_batches", "of_first", "of_last"),
    [(complete(24), [1, 9, 17], [], []), (first_third_hears_all(24), [1], [*range(9, 25)], [])],
    ids=["all", "a third"],
)
def test_who_reads_batches(
    network: Any, domain: int, experiment: Any, of_batches: list[int], of_first: list[int], of_last: list[int]
) -> None:
    """Processes that hear most of the network, on the node of their first agent, and no topic of single agents."""
    readers = {
        "/states": sorted(["recorder", *(f"agent_{i}" for i in of_batches)]),
        "/agent_1/state": sorted(f"agent_{i}" for i in of_first),
        "/agent_24/state": sorted(f"agent_{i}" for i in of_last),
    }
    large = {"duration": 1000, "processes": 3, "replicas": 16}  # so that they are soon seen in the bag
    run = network.record(network.file(**experiment, run=large), "--domain", str(domain))
    network.wait_until_moving()
    assert_endpoints({topic: [[name, "RELIABLE"] for name in names] for topic, names in readers.items()}, {}, domain)
    run.terminate()
    run.communicate(timeout=60)


def cores_of(pid: int) -> set[int]:
    """Cores that any thread of a process may run on."""
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        return set.union(*(os.sched_getaffinity(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()))
    return set()


@pytest.mark.parametrize("pin", [True, False])
def test_processes_keep_to_one_core_each(network: Any, pin: bool) -> None:
    """Where there are more of them than cores; whoever comes back keeps to the same one."""
    cores = os.sched_getaffinity(0)
    if not 2 <= len(cores) <= 5:
        pytest.skip(f"this machine: {len(cores)} cores: nothing to pin 6 processes to")
    file = network.file(run={"duration": 500, "replicas": 64})
    run = network.record(file, *([] if pin else ["--no-pin"]))
    network.wait_until_moving()
    kept = {process.agent: cores_of(process.pid) for process in network.processes("agent")}
    if pin:
        assert {len(own) for own in kept.values()} == {1}
        assert len(set.union(*kept.values())) == min(len(cores), 5)
    else:
        assert list(kept.values()) == [cores] * 5
    victim = network.processes("agent")[0]
    victim.kill()

    def back() -> bool:
        others = [p for p in network.processes("agent") if p.agent == victim.agent and p != victim]
        return any(cores_of(process.pid) == kept[victim.agent] for process in others)

    network.wait_for(back, 10, "the agent on its core again")
    run.send_signal(signal.SIGINT)
    run.communicate(timeout=30)
    assert run.returncode == 3
