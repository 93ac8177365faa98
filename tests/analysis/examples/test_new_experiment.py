"""New experiment files: valid whatever is chosen, and they say what was chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from msg_analysis.experiment.examples import KINDS, Choices, experiment_name, experiment_text
from msg_analysis.experiment.experiment import Experiment

GRAPHS = {
    "line": nx.path_graph,
    "ring": nx.cycle_graph,
    "star": lambda m: nx.star_graph(m - 1),
    "complete": nx.complete_graph,
}


@st.composite
def choices(draw: Any) -> Choices:
    graphs = draw(st.lists(st.sampled_from(KINDS), min_size=1, unique=True))
    agents = draw(st.integers(3 if "ring" in graphs else 2, 40))
    discrete = draw(st.booleans())
    return Choices(
        agents=agents,
        graphs=tuple(graphs),
        time="discrete" if discrete else "continuous",
        switching=draw(st.floats(1e-3, 0.99 if discrete else 1e3)),
        noise=draw(st.floats(1e-6, 1e6)),
        loss=draw(st.floats(0.0, 0.9)),
        leaders=tuple(draw(st.lists(st.integers(1, agents), unique=True, max_size=3))),
        seed=draw(st.integers(0, 2**31)),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(chosen=choices())
def test_every_choice_gives_a_valid_file(chosen: Choices, tmp_path: Path) -> None:
    file = tmp_path / "network.yaml"
    file.write_text(experiment_text("network", chosen))
    assert max(map(len, file.read_text().splitlines())) <= 120
    experiment = Experiment.load(file)
    experiment.require_available()
    assert (experiment.agents, experiment.time, experiment.steps) == (chosen.agents, chosen.time, 4000)
    assert experiment.run.seed == chosen.seed
    assert experiment.spec.noise.loss.default == chosen.loss
    np.testing.assert_allclose(experiment.noise_gain, [chosen.noise * np.eye(chosen.agents)] * len(chosen.graphs))
    for graph, kind in zip(experiment.graph_list, chosen.graphs, strict=True):
        assert graph.name == kind
        oracle = nx.to_numpy_array(GRAPHS[kind](chosen.agents))
        largest = np.linalg.eigvalsh(np.diag(oracle.sum(axis=0)) - oracle)[-1]
        assert chosen.time == "discrete" or experiment.step_length * (largest + bool(chosen.leaders)) <= 0.5 + 1e-12
        np.testing.assert_array_equal(graph.adjacency, oracle)
    assert experiment.problem == ("tracking" if chosen.leaders else "consensus")
    assert set(1 + experiment.leader_gains.nonzero()[0]) == set(chosen.leaders)
    if len(chosen.graphs) > 1:
        stay = 1.0 if chosen.time == "discrete" else 0.0
        np.testing.assert_allclose(np.diag(experiment.chain.matrix), stay - chosen.switching, rtol=1e-9)


def test_the_file_as_it_is() -> None:
    text = experiment_text("lab", Choices())
    assert text.splitlines()[1:14] == [
        "name: lab",
        "problem: consensus              # consensus: the agents agree | tracking: they follow leaders",
        "time: continuous                # continuous: Euler steps of run.dt | discrete: W = exp(-Z), one step is 1",
        "agents: 5",
        "",
        "graphs:                         # the order here is the order of the modes",
        "  line: {path: [1, 2, 3, 4, 5]}",
        "  ring: {cycle: [1, 2, 3, 4, 5]}",
        "",
        "switching:",
        "  rates:                        # from: {to: jumps per unit of time}",
        "    line: {ring: 0.5}",
        "    ring: {line: 0.5}",
    ]
    assert yaml.safe_load(text)["run"] == {"dt": 0.1, "duration": 400, "replicas": 16, "seed": 1, "pace": "lockstep"}


@pytest.mark.parametrize(
    ("stem", "name"),
    [("lab", "lab"), ("My net-2", "my_net_2"), ("3rd", "network_3rd"), ("_x", "network_x"), ("日本", "network")],
)
def test_the_name_of_the_file_becomes_that_of_the_experiment(stem: str, name: str) -> None:
    assert experiment_name(stem) == name
    Experiment.parse(yaml.safe_load(experiment_text(name, Choices())))
