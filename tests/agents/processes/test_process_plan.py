"""The plan of a network."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_agents.environment import DISCOVERY_TIMEOUT
from msg_agents.process_layout import (
    MOST_PROCESSES,
    MOST_UNAIDED,
    RECORDER,
    ProcessSpec,
    count_processes,
    lay_out_network,
    partners,
    place,
)
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment


def experiment(agents: int, processes: Any) -> Experiment:
    return Experiment.parse(
        {
            "name": "plan",
            "problem": "consensus",
            "time": "continuous",
            "agents": agents,
            "graphs": {"path": {"path": list(range(1, agents + 1))}, "star": {"star": {"center": 1}}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 0.001, "duration": 0.01, "start": "zero", "processes": processes},
        }
    )


def plan(agents: int, processes: Any, bag: Path | None = Path("/bag")) -> list[ProcessSpec]:
    return lay_out_network(experiment(agents, processes), Path("/run.json"), bag)


def numbers(process: ProcessSpec) -> list[int]:
    """Agents as the command line names them."""
    words = process.arguments
    return [int(value) for option, value in pairwise(words) if option == "--agent"]


@given(st.integers(2, 110), st.integers(1, MOST_UNAIDED))
def test_every_agent_exactly_once(agents: int, processes: int) -> None:
    hosts = [process for process in plan(agents, processes) if process.agents]
    assert len(hosts) == min(agents, processes)
    assert [agent for host in hosts for agent in host.agents] == list(range(agents))
    assert [number for host in hosts for number in numbers(host)] == list(range(1, agents + 1))
    nodes = [node for process in plan(agents, processes) for node in process.nodes]
    assert nodes == ["recorder", *(f"agent_{agent + 1}" for agent in range(agents)), "switcher"]
    sizes = [len(host.agents) for host in hosts]
    assert max(sizes) - min(sizes) <= 1
    assert len({host.name for host in hosts}) == len(hosts)


@pytest.mark.parametrize(
    ("cores", "agents", "expected"),
    [(2, 2, 2), (2, 8, 8), (2, 9, 2), (1, 9, 1), (1, 100, 1), (8, 9, 2), (8, 100, 8), (64, 100, 13)],
)
def test_auto(monkeypatch: pytest.MonkeyPatch, cores: int, agents: int, expected: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert count_processes(experiment(agents, "auto")) == expected


@pytest.mark.parametrize("cores", [1, 2, 14, 64, 256])
def test_auto_never_asks_for_too_many(monkeypatch: pytest.MonkeyPatch, cores: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert count_processes(experiment(200, "auto")) <= MOST_PROCESSES


@pytest.mark.parametrize("most", [MOST_UNAIDED, MOST_PROCESSES])
def test_too_many_processes(most: int) -> None:
    for processes in ("one_per_agent", most + 1):
        with pytest.raises(InputError, match=rf"run\.processes: {processes} .*at most {most}"):
            lay_out_network(experiment(most + 1, processes), Path("/run.json"), None, most=most)
    assert len(lay_out_network(experiment(most, "one_per_agent"), Path("/run.json"), None, most=most)) == most + 1


def test_large_networks_are_given_time_to_find_each_other() -> None:
    def timeouts(agents: int, processes: Any) -> set[str]:
        return {
            process.arguments[process.arguments.index("--discovery-timeout") + 1]
            for process in plan(agents, processes)
            if "--discovery-timeout" in process.arguments
        }

    assert timeouts(5, "auto") == set()
    (timeout,) = timeouts(40, "one_per_agent")  # the same for all
    assert float(timeout) > DISCOVERY_TIMEOUT


def test_names_and_commands() -> None:
    recorder, first, second, switcher = plan(5, 2)
    assert [process.name for process in (recorder, first, second, switcher)] == [
        "recorder",
        "agents_1_to_2",
        "agents_3_to_5",
        "switcher",
    ]
    assert recorder.arguments == ("recorder", "/run.json", "--out", "/bag", "--compression", "zstd")
    assert first.arguments == (
        *("agent", "/run.json", "--agent", "1", "--agent", "2"),
        *("--await", "recorder"),
    )
    assert switcher.arguments == ("switcher", "/run.json", "--await", "recorder")
    assert [process.name for process in plan(2, "one_per_agent")][1:3] == ["agent_1", "agent_2"]


def test_without_a_bag_nobody_waits_for_a_recorder() -> None:
    processes = plan(3, "auto", bag=None)
    assert [process.name for process in processes] == ["agent_1", "agent_2", "agent_3", "switcher"]
    assert not any("--await" in process.arguments for process in processes)


def test_neighbours_share_a_core() -> None:
    placed = place(plan(12, 6), [0, 1])
    first = {"agents_1_to_2": 0, "agents_3_to_4": 0, "agents_5_to_6": 0}
    assert placed == first | {"agents_7_to_8": 1, "agents_9_to_10": 1, "agents_11_to_12": 1}


@given(st.integers(2, 30), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_partners(agents: int, processes: int, seed: int) -> None:
    """Processes whose agents are neighbours in the union of both directions, and the central ones with all."""
    listens = np.random.default_rng(seed).random((agents, agents)) < 0.1
    np.fill_diagonal(listens, False)
    plans = plan(agents, processes)
    found = partners(plans, listens)
    of_agent = {agent: process.first_node for process in plans for agent in process.agents}
    graph = nx.quotient_graph(
        nx.from_numpy_array(listens | listens.T), lambda a, b: of_agent[a] == of_agent[b], relabel=False
    )
    expected = {
        of_agent[min(group)]: {of_agent[min(other)] for other in graph[group]} | {RECORDER, "switcher"}
        for group in graph.nodes
    }
    all_names = set(expected) | {RECORDER, "switcher"}
    assert found == expected | {name: all_names - {name} for name in (RECORDER, "switcher")}
