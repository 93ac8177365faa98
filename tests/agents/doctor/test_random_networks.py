"""Random networks of the tests: valid, and of every kind."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import networkx as nx
import pytest
from random_networks import GRAPH_NAMES, MOST_AGENTS, random_document

from msg_analysis.experiment.experiment import Experiment

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
