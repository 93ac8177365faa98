"""The experiment file: what valid files mean, and that they survive being written and read again."""

import json
import math
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import yaml
from random_networks import random_document

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.limits import unavailable, unpredictable
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.experiment.spec import ExperimentSpec, json_schema

ROOT = Path(__file__).parents[3]
EXPERIMENTS = ROOT / "analysis/msg_analysis/experiment/bundled"

SMALL: dict[str, Any] = {"name": "small", "graphs": {"line": {"path": [1, 2, 3]}}}


def small(**changes: Any) -> Experiment:
    return Experiment.parse(SMALL | changes)


def adjacency_of(graph: dict[str, Any], agents: int) -> FloatArray:
    """Adjacency of a consensus graph that is completed by a line, so that any graph is accepted."""
    line = {"path": list(range(1, agents + 1))}
    switching = {"generator": [[-1, 1], [1, -1]]}
    experiment = small(graphs={"graph": graph, "line": line}, switching=switching, agents=agents)
    return experiment.graph_list[0].adjacency


def test_defaults_of_a_minimal_file() -> None:
    experiment = small()
    assert experiment.to_document() == {
        "name": "small",
        "problem": "consensus",
        "time": "continuous",
        "agents": 3,
        "graphs": {"line": {"path": [1, 2, 3]}},
        "switching": {"scale": 1.0, "initial": "stationary"},
        "noise": {"process": 1.0, "broadcast": 0.0, "link": 0.0, "loss": 0.0, "on_loss": "own", "delay": 0},
        "run": {
            "dt": 0.05,
            "duration": 100.0,
            "replicas": 1,
            "seed": 0,
            "start": "stationary",
            "pace": "lockstep",
            "speed": 1.0,
            "processes": "auto",
        },
    }
    assert experiment.steps == 2000
    assert experiment.reference == 0.0
    assert experiment.chain.matrix.tolist() == [[0.0]]
    assert not experiment.leader_gains.any()


def test_shipped_experiments_are_valid_and_say_what_the_golden_files_say() -> None:
    for name in ("line_ring", "tracking", "discrete"):
        shipped = Experiment.load(EXPERIMENTS / f"{name}.yaml")
        assert shipped == Experiment.load(ROOT / f"tests/data/golden/{name}.yaml")


@pytest.mark.parametrize(
    ("graph", "expected"),
    [
        ({"path": [3, 1, 2]}, nx.Graph([(3, 1), (1, 2)])),
        ({"cycle": [1, 3, 5, 2, 4]}, nx.Graph([(1, 3), (3, 5), (5, 2), (2, 4), (4, 1)])),
        ({"star": {"center": 4}}, nx.Graph([(4, i) for i in (1, 2, 3, 5, 6)])),
        ({"complete": True}, nx.relabel_nodes(nx.complete_graph(6), lambda i: i + 1)),
        ({"grid": [2, 3]}, nx.convert_node_labels_to_integers(nx.grid_2d_graph(2, 3), 1, "sorted")),
        ({"edges": [[1, 2], [5, 2]]}, nx.Graph([(1, 2), (2, 5)])),
        ({"edges": []}, nx.Graph()),
        ({"edges": [[1, 2, 2.5]]}, nx.Graph([(1, 2, {"weight": 2.5})])),
        ({"arcs": [[1, 2, 0.5]]}, nx.DiGraph([(1, 2, {"weight": 0.5})])),
    ],
)
def test_graphs_against_networkx(graph: dict[str, Any], expected: Any) -> None:
    """Of an arc, the target listens: row 2 has the weight of 1 -> 2, which networkx has in row 1."""
    expected.add_nodes_from(range(1, 7))
    assert np.array_equal(adjacency_of(graph, 6), nx.to_numpy_array(expected, nodelist=range(1, 7)).T)


def test_noise_gain() -> None:
    """Of all graphs, or by name, in whatever order; the gains are in the order of the graphs."""
    process = {"c": [1, 0.5, 0], "a": 2, "b": [[1, -2, 3], [0, 1, 0], [0, 0, 1]]}
    gains = {"a": 2 * np.eye(3), "b": np.array(process["b"]), "c": np.diag([1, 0.5, 0])}
    for name, gain in gains.items():
        assert np.array_equal(small(noise={"process": process[name]}).noise_gain, gain[None])
    graphs = {name: {"path": [1, 2, 3]} for name in gains}
    switching = {"generator": [[-2, 1, 1], [1, -2, 1], [1, 1, -2]]}
    experiment = small(graphs=graphs, switching=switching, noise={"process": process})
    assert np.array_equal(experiment.noise_gain, [*gains.values()])
    assert not experiment.noise.steps_only


@pytest.mark.parametrize(("gain", "written"), [("inf", "inf"), (math.inf, "inf"), (2, 2.0)])
def test_leaders(gain: Any, written: Any) -> None:
    experiment = small(problem="tracking", leaders={"agents": [3, 1], "gain": gain, "reference": -1.5})
    text = json.dumps(experiment.to_document(), allow_nan=False)
    assert json.loads(text)["leaders"]["gain"] == written
    assert Experiment.parse(json.loads(text)) == experiment
    assert experiment.leader_gains.tolist() == [float(gain), 0.0, float(gain)]
    assert experiment.reference == -1.5


def test_rates_are_the_generator() -> None:
    graphs = {"a": {"path": [1, 2, 3]}, "b": {"cycle": [1, 2, 3]}, "c": {"star": {"center": 1}}}
    rates = {"a": {"b": 1.0}, "b": {"c": 2.0, "a": 4}, "c": {"a": 3.0}}
    by_name = small(graphs=graphs, switching={"rates": rates, "scale": 0.5})
    generator = [[-0.5, 0.5, 0.0], [2.0, -3.0, 1.0], [1.5, 0.0, -1.5]]
    assert by_name.chain.matrix.tolist() == generator
    by_matrix = small(graphs=graphs, switching={"generator": generator})
    assert by_matrix.chain.matrix.tolist() == generator


def test_rows_within_the_tolerance_are_made_exact() -> None:
    third = 0.333333333333
    graphs = {name: {"path": [1, 2, 3]} for name in "abc"}
    experiment = small(graphs=graphs, time="discrete", switching={"transition": [[third, third, 1 - 2 * third]] * 3})
    assert experiment.chain.matrix.sum(axis=1) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("dt", "duration", "steps"), [(0.1, 0.3, 3), (0.05, 400, 8000), (0.3, 0.9, 3), (0.25, 0.25, 1)]
)
def test_steps_are_whole_whatever_the_rounding(dt: float, duration: float, steps: int) -> None:
    assert small(run={"dt": dt, "duration": duration}).steps == steps


def test_the_order_of_the_graphs_matters() -> None:
    a, b = ({name: {"path": [1, 2, 3]} for name in order} for order in ("ab", "ba"))
    switching = {"generator": [[-1, 1], [1, -1]]}
    assert small(graphs=a, switching=switching) != small(graphs=b, switching=switching)
    assert small(graphs=a, switching=switching) == small(graphs=dict(a), switching=switching)


def test_everything_runs_and_what_is_too_large_has_no_prediction() -> None:
    assert unavailable(small()) == []
    noise = {"broadcast": 0.1, "link": 0.2, "loss": 0.3, "delay": 2, "on_loss": "hold", "burst": 5}
    for pace in ("lockstep", "realtime"):
        noisy = small(noise=noise, run={"pace": pace})
        noisy.require_available()
        noisy.require_available("predict")
        assert unpredictable(noisy) is None
    large = small(graphs={"all": {"complete": True}}, agents=5, noise=noise)
    large.require_available()
    (line,) = unavailable(large, "predict")
    assert line.startswith("noise.burst: 5.0: has no exact prediction: 2^20 states of 20 links")
    assert f"{unpredictable(large)}; `predict` samples the steady errors" == line
    with pytest.raises(NotAvailableError, match=r"noise\.burst: 5"):
        large.require_available("predict")


def test_numbers_and_words_are_those_of_yaml_1_2(tmp_path: Path) -> None:
    file = tmp_path / "file.yaml"
    file.write_text("name: no\ngraphs: {on: {path: [1, 02, 3]}}\nrun: {dt: 1e-3, duration: 1.0e+1}\n")
    experiment = Experiment.load(file)
    assert experiment.name == "no"
    assert experiment.graph_list[0].name == "on"
    assert experiment.agents == 3
    assert experiment.steps == 10000
    file.write_text("name: true\ngraphs: {a: {path: [1, 2]}}\n")
    with pytest.raises(ExperimentError, match="name: true: expected a text"):
        Experiment.load(file)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: a\nname: b\n", "line 2, column 1: key 'name' appears twice"),
        ("run:\n  seed: 1\n  dt: 1\n  seed: 2\n", "line 4, column 3: key 'seed' appears twice"),
        ("name: [1\n", "line 2"),
        ("a: &x [*x]\n", "alias 'x' stands inside what it names"),
        ("? [1, 2]\n: 3\n", "line 1"),
        ("a: !!python/object:os.system {}\n", "line 1"),
        ("", "experiment: null: expected keys with values"),
        ("- 1\n", "experiment: [1]: expected keys with values"),
        ("a: 1\n---\nb: 2\n", "single document"),
        ("a: " + "9" * 5000, "not YAML"),
        ("[" * 5000, "nested too deeply"),
        ("\0", "not YAML"),
    ],
)
def test_files_that_are_not_experiments(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "file.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        Experiment.load(file)
    assert str(caught.value).startswith(str(file))
    assert expected in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nope\.yaml: no such file"):
        Experiment.load(tmp_path / "nope.yaml")
    with pytest.raises(InputError, match="is a directory"):
        Experiment.load(tmp_path)
    (tmp_path / "binary").write_bytes(b"name: \xff")
    with pytest.raises(InputError, match="byte 6: not UTF-8"):
        Experiment.load(tmp_path / "binary")


def test_schema_describes_every_key() -> None:
    schema = json_schema()
    for section in (schema, *schema["$defs"].values()):
        assert section["description"]
        for key, entry in section["properties"].items():
            assert "description" in entry or "$ref" in entry or "anyOf" in entry, key
    assert set(schema["properties"]) == set(ExperimentSpec.model_fields)


@pytest.mark.parametrize("seed", range(60))
def test_document_survives_json_and_yaml(seed: int) -> None:
    """Of a random network, with numbers of all digits, from small to large."""
    document = random_document(seed)
    start = np.random.default_rng(seed).standard_normal(document["agents"]) * 10.0 ** (seed - 30)
    document["run"] |= {"start": start.tolist(), "seed": 2**64 - seed}
    experiment = Experiment.parse(document)
    written = experiment.to_document()
    for again in (
        json.loads(json.dumps(written, allow_nan=False)),
        yaml.load(yaml.dump(written, Dumper=yaml.CSafeDumper, sort_keys=False), yaml.CSafeLoader),
    ):
        other = Experiment.parse(again)
        assert other == experiment
        assert other.to_document() == written
        assert np.array_equal(other.chain.matrix, experiment.chain.matrix)
        assert np.array_equal(other.noise_gain, experiment.noise_gain)
        for one, two in zip(other.graph_list, experiment.graph_list, strict=True):
            assert np.array_equal(one.adjacency, two.adjacency)
    assert experiment != experiment.with_run(seed=experiment.run.seed + 1)
