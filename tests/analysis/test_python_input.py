"""What Python may give as an experiment: arrays, graphs of other libraries, names of agents, other values."""

from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import scipy.sparse

from msg_analysis import Experiment, ExperimentError, InputError
from msg_analysis.theory.leaders import system_error

WEIGHTED = np.array([[0, 1, 0], [1, 0, 2], [0, 2, 0]])
LINKS = [(1, 2, 1.0), (2, 3, 2.0)]
NAMES = ["north", "south", "west"]
DIRECTED = nx.DiGraph()
DIRECTED.add_weighted_edges_from([("north", "south", 1), ("south", "north", 1), ("south", "west", 2)])


def parsed(graph: Any, **changes: Any) -> Experiment:
    return Experiment.parse({"name": "given", "graphs": {"g": graph}, "run": {"duration": 1}} | changes)


@pytest.mark.parametrize(
    "graph",
    [
        WEIGHTED,
        WEIGHTED.astype(np.float32),
        scipy.sparse.csr_array(WEIGHTED),
        scipy.sparse.coo_matrix(WEIGHTED),
        {"adjacency": scipy.sparse.csc_array(WEIGHTED)},
        {"edges": [(np.int64(1), 2), (2, 3, np.float64(2))]},
    ],
)
def test_graphs(graph: Any) -> None:
    experiment = parsed(graph)
    assert experiment.graph_list[0].edges == LINKS
    assert Experiment.parse(experiment.to_document()) == experiment


def test_numbers_and_arrays() -> None:
    """Wherever a document has a number or a list; what is kept are numbers and lists of Python."""
    run = {"dt": 0.05, "duration": 2.0, "seed": 3, "start": [1.0, 0.0, 2.0]}
    plain = parsed({"path": range(1, 4)}, noise={"process": [1.0, 2.0, 3.0], "loss": 0.25}, run=run)
    run = {"dt": np.float64(0.05), "duration": np.int32(2), "seed": np.uint8(3), "start": np.array([1, 0, 2])}
    noise = {"process": np.array([1, 2, 3]), "loss": np.float32(0.25)}
    given = parsed({"path": np.arange(1, 4)}, noise=noise, run=run)
    assert given == plain
    assert [type(value) for value in (given.run.seed, given.noise.loss.default)] == [int, float]


@pytest.mark.parametrize(
    ("graph", "arcs"),
    [
        ({"path": NAMES}, [(2, 1), (1, 2), (3, 2), (2, 3)]),
        ({"path": ["north", 2, "west"]}, [(2, 1), (1, 2), (3, 2), (2, 3)]),
        ({"cycle": NAMES}, [(2, 1), (3, 1), (1, 2), (3, 2), (1, 3), (2, 3)]),
        ({"edges": [["west", "north"], ["south", 3, 2]]}, [(3, 1), (3, 2), (1, 3), (2, 3)]),
        ({"arcs": [["north", "south"], ["south", "north"], ["north", "west"]]}, [(2, 1), (1, 2), (1, 3)]),
        ({"star": {"center": "south"}}, [(2, 1), (1, 2), (3, 2), (2, 3)]),
        (DIRECTED, [(2, 1), (1, 2), (2, 3)]),
    ],
)
def test_names_of_agents(graph: Any, arcs: list[tuple[int, int]]) -> None:
    experiment = parsed(graph, names=NAMES, run={"start": {"west": 2.0, 1: 1.0}})
    assert [arc[:2] for arc in experiment.graph_list[0].arcs] == arcs
    assert experiment.run.start == [1.0, 0.0, 2.0]


def test_names_come_from_the_graphs_where_none_are_given() -> None:
    graphs = {"a": {"path": ["b", "c"]}, "d": {"edges": [["a", "b"], ["c", 1]]}}
    experiment = Experiment.parse({"name": "two", "graphs": graphs, "switching": {"generator": [[-1, 1], [1, -1]]}})
    assert experiment.names == ["b", "c", "a"]
    assert experiment.graph_list[1].edges == [(1, 2, 1.0), (1, 3, 1.0)]


@pytest.mark.parametrize(
    ("graph", "count"),
    [
        ({"path": [1, 2, 3]}, 2),
        ({"cycle": [1, 2, 3]}, 3),
        ({"grid": [1, 3]}, 2),
        ({"star": {"center": 1}}, 2),
        ({"complete": True}, 3),
    ],
)
def test_one_weight_for_all_links(graph: dict[str, Any], count: int) -> None:
    links = parsed(graph | {"weight": np.float64(0.5)}, agents=3).graph_list[0].edges
    assert [weight for *_, weight in links] == [0.5] * count


def test_matrices_in_files(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", WEIGHTED)
    np.savetxt(tmp_path / "a.csv", WEIGHTED, delimiter=",")
    for name in ("a.npy", "a.csv"):
        document = {"name": "file", "graphs": {"g": {"adjacency": name}}}
        experiment = Experiment.parse(document, directory=tmp_path)
        assert experiment.graph_list[0].edges == LINKS
        assert Experiment.parse(experiment.to_document()) == experiment


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"0,1\n1", "expected a matrix of numbers"),
        ("a.csv", b"0,x\n1,0", "expected a matrix of numbers"),
        ("a.csv", b"0,-1\n-1,0", "finite numbers >= 0"),
        ("a.csv", b"0,1,0\n1,0,0", "expected a square matrix"),
        ("a.npy", b"not numpy", "expected a matrix of numbers"),
        ("a.txt", b"0,1\n1,0", "or a file .csv or .npy"),
        ("b.npy", None, "no such file"),
    ],
)
def test_bad_matrix_files(name: str, content: bytes | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ExperimentError, match=rf"graphs\.g\.adjacency: .*{words}"):
        Experiment.parse({"name": "file", "graphs": {"g": {"adjacency": name}}}, directory=tmp_path)


def test_objects_in_a_file_are_not_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[0, object()]], dtype=object), allow_pickle=True)
    with pytest.raises(ExperimentError, match="allow_pickle=False"):
        Experiment.parse({"name": "file", "graphs": {"g": {"adjacency": "a.npy"}}}, directory=tmp_path)


@pytest.mark.parametrize(
    ("graph", "changes", "words"),
    [
        (np.array([[0, np.nan], [1, 0]]), {}, r"graphs\.g\.adjacency\[1\]\[2\]"),
        ({"path": ["a", "b", "x"]}, {"names": ["a", "b", "c"]}, 'node "x": expected one of the names a, b, c'),
        ({"edges": [[1, 2]], "weight": 2}, {}, r"graphs\.g\.weight: 2.0: expected with path, cycle"),
        ({"path": [1, 2], "weight": 0}, {}, r"graphs\.g\.weight: 0: expected a number > 0"),
        ({"path": [1, 2]}, {"run": {"start": {"x": 1}}}, r"run\.start: \"x\": expected agents 1 to 2"),
        ({"path": [1, 2]}, {"run": {"start": {3: 1}}}, r"run\.start: 3: expected agents 1 to 2"),
        ({"path": [1, 2]}, {"run": {"start": np.zeros(3)}}, r"run\.start"),
        ({"path": [1, 2]}, {"run": {"seed": np.float64(0.5)}}, r"run\.seed: 0.5: expected a whole number"),
    ],
)
def test_one_clear_error(graph: Any, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ExperimentError, match=words) as caught:
        parsed(graph, **changes)
    assert len(caught.value.problems) == 1


def test_other_values() -> None:
    base = parsed({"path": NAMES})
    assert base.with_run(seed=np.int64(4)).run.seed == 4
    assert base.with_noise(process=np.ones(3), loss=0.1).noise.process == [1.0, 1.0, 1.0]
    led = base.with_leaders("west", 1, gain=2.0)
    assert (led.problem, led.spec.leaders and led.spec.leaders.agents) == ("tracking", [3, 1])
    assert led.with_leaders(reference=3.0).spec.leaders == led.spec.leaders.model_copy(update={"reference": 3.0})
    assert led.with_leaders() == base
    two = base.with_graphs({"a": WEIGHTED, "b": {"cycle": NAMES}}, switching={"rates": {"a": {"b": 1}, "b": {"a": 1}}})
    assert [graph.name for graph in two.graph_list] == ["a", "b"]
    others = two.with_switching(scale=3), two.with_switching(generator=np.array([[-2, 2], [1, -1]]))
    others += (two.with_values({"switching.rates.a.b": 5, "run.seed": 2}),)
    assert [other.chain.matrix[0, 1] for other in others] == [3.0, 2.0, 5.0]
    assert base.with_values({}) == base


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda base: base.with_run(sed=1), r"run\.sed: unknown key"),
        (lambda base: base.with_noise(process=-1), r"noise\.process: -1"),
        (lambda base: base.with_leaders("east"), "expected one of the names north, south, west"),
        (lambda base: base.with_leaders(gain=1), r"leaders\.agents: missing"),
        (lambda base: base.with_graphs({}), "graphs"),
        (lambda base: base.with_values({"noise.process.": 1}), "^experiment: noise.process.: not a key"),
        (lambda base: base.with_values({"names[4]": "x"}), "expected a list with at least 4 entries"),
    ],
)
def test_other_values_that_are_wrong(change: Any, words: str) -> None:
    with pytest.raises(ExperimentError, match=words):
        change(parsed({"path": NAMES}))


def test_agents_count_from_1() -> None:
    experiment = parsed({"path": NAMES})
    assert experiment.indices(["west", 1, np.int64(2)]) == [2, 0, 1]
    assert experiment.leaders(1).sets[0][1] == (2,)
    assert system_error(experiment, ["south"]) == system_error(experiment, [2]) == experiment.leaders(1).sets[0][0]
    run = experiment.simulate()
    drawn = run.plot(["west", 1]).axes[0].lines
    np.testing.assert_array_equal([line.get_ydata() for line in drawn], run.states[:, [2, 0], 0].T)
    for wrong in ("east", 0, 4, -1, 1.5, "1"):
        with pytest.raises(InputError, match=r"agents: .*expected numbers from 1 to 3, or one of the names"):
            experiment.indices([wrong])


def test_errors_speak_of_arguments() -> None:
    """InputError is a ValueError, and names no option of the command line."""
    base = parsed({"path": [1, 2, 3]})
    for ask, words in (
        (lambda: base.transient([0.01]), "times: 0.01 is not a multiple of the step 0.05"),
        (lambda: base.transient([1.0, 0.5]), "times"),
        (lambda: base.leaders(1, law="discrete"), "law discrete"),
        (lambda: base.with_leaders(1).transient([0], unreduced=True), "unreduced"),
        (lambda: base.spectrum(frequencies=[-1]), "frequencies"),
        (lambda: base.plan(2.0), "precision"),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            ask()
        assert isinstance(caught.value, InputError)
        assert "--" not in str(caught.value)
