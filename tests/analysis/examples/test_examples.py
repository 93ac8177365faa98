"""The examples, by which rule commands find an experiment, and new experiment files."""

import json
import runpy
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pages import EXPERIMENTS, ROOT

from msg_analysis import Experiment
from msg_analysis.cli.main import main
from msg_analysis.errors import InputError
from msg_analysis.experiment.examples import (
    KINDS,
    Choices,
    experiment_name,
    experiment_text,
    find,
    names,
    shows,
    text_of,
)
from msg_analysis.sweeps.grid import load_sweep

OWN = {"name": "own", "graphs": {"line": {"path": [1, 2]}}}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_example_says_what_it_shows_in_one_line() -> None:
    assert names() == sorted(file.stem for file in EXPERIMENTS.glob("*.yaml"))
    for name in names():
        assert 20 < len(shows(name)) < 120
        assert yaml.safe_load(text_of(name))["name"] == name
    assert shows("fast_switching") == "The network of slow_switching.yaml, switching a hundred times as fast"


def test_the_recorded_robots_are_made_by_their_script() -> None:
    rows = runpy.run_path(str(ROOT / "benchmarks/recorded_robots.py"))["rows"]()
    assert list(rows) == (EXPERIMENTS / "recorded_robots.csv").read_text().splitlines()


def test_a_name_is_an_example(here: Path) -> None:
    (here / "line_ring").mkdir()  # a directory is no file of that name
    assert find("line_ring") == EXPERIMENTS / "line_ring.yaml"


@pytest.mark.parametrize("file", ["line_ring", "line_ring.yaml"])
def test_a_file_of_that_name_wins(file: str, here: Path) -> None:
    (here / file).write_text(yaml.safe_dump(OWN))
    assert find("line_ring") == find(Path("line_ring")) == Path(file)
    assert Experiment.load("line_ring").name == "own"
    assert find("line_ring", EXPERIMENTS.parent) == EXPERIMENTS / "line_ring.yaml"  # there is no such file there


@pytest.mark.parametrize("path", ["./line_ring", "nowhere/line_ring", "/line_ring", "other.yaml", "line_ring.json"])
def test_a_path_is_no_example(path: str) -> None:
    assert find(path) == Path(path)


def test_neither_file_nor_example() -> None:
    with pytest.raises(InputError) as error:
        find("lin_ring")
    words = f"no such file, and no example of this name: expected a file, or one of {', '.join(names())}: "
    assert str(error.value) == f"lin_ring: {words}did you mean line_ring?"
    with pytest.raises(InputError, match=r"^line_ring\.yaml: no such file: check the path, or give line_ring"):
        find("line_ring.yaml")
    with pytest.raises(InputError, match=r"^lin_ring: no example of this name: expected one of discrete, "):
        text_of("lin_ring")


def test_info_takes_both(here: Path) -> None:
    """A bag of that name wins, too; any other directory does not."""
    run = CliRunner()
    (here / "discrete").mkdir()
    assert json.loads(run.invoke(main, ["info", "discrete", "--json"]).stdout)["name"] == "discrete"
    (here / "discrete").rmdir()
    Experiment.parse(OWN | {"run": {"duration": 1, "start": "zero"}}).simulate().save(here / "discrete")
    assert json.loads(run.invoke(main, ["info", "discrete", "--json"]).stdout)["experiment"] == "own"


def test_a_sweep_of_an_example(here: Path) -> None:
    """The directory that counts is that of the sweep file."""
    below = here / "below"
    below.mkdir()
    sweep = below / "sweep.yaml"
    sweep.write_text(yaml.safe_dump({"experiment": "line_ring", "over": {"switching.scale": [1.0]}}))
    (here / "line_ring.yaml").write_text(yaml.safe_dump(OWN))
    assert load_sweep(sweep).experiment == "line_ring"
    (below / "line_ring.yaml").write_text(yaml.safe_dump(OWN | {"switching": {"rates": {}}}))
    assert load_sweep(sweep).experiment == "own"


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
    time = draw(st.sampled_from(["continuous", "discrete"]))
    return Choices(
        agents=agents,
        graphs=tuple(graphs),
        time=time,
        switching=draw(st.floats(1e-3, 0.99 if time == "discrete" else 1e3)),
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
    assert (experiment.run.seed, experiment.spec.noise.loss.default) == (chosen.seed, chosen.loss)
    np.testing.assert_allclose(experiment.noise_gain, [chosen.noise * np.eye(chosen.agents)] * len(chosen.graphs))
    assert [graph.name for graph in experiment.graph_list] == list(chosen.graphs)
    for graph, kind in zip(experiment.graph_list, chosen.graphs, strict=True):
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
    assert text.splitlines()[1:8] == [
        "name: lab",
        "problem: consensus              # consensus: the agents agree | tracking: they follow leaders",
        "time: continuous                # continuous: Euler steps of run.dt | discrete: W = exp(-Z), one step is 1",
        "agents: 5",
        "",
        "graphs:                         # the order here is the order of the modes",
        "  line: {path: [1, 2, 3, 4, 5]}",
    ]
    assert yaml.safe_load(text)["run"] == {"dt": 0.1, "duration": 400, "replicas": 16, "seed": 1, "pace": "lockstep"}


@pytest.mark.parametrize(
    ("stem", "name"),
    [("lab", "lab"), ("My net-2", "my_net_2"), ("3rd", "network_3rd"), ("_x", "network_x"), ("日本", "network")],
)
def test_the_name_of_the_file_becomes_that_of_the_experiment(stem: str, name: str) -> None:
    assert experiment_name(stem) == name
    Experiment.parse(yaml.safe_load(experiment_text(name, Choices())))
