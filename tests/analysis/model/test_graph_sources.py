"""Graphs from elsewhere against networkx, and the names of their nodes."""

import csv
import json
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from experiments import Experiment, RunRecord
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.inference.comparison import law_identity

TOWNS = ["Ulm", "Bonn", "Kiel", "Jena"]


def towns(directed: bool) -> Any:
    graph = nx.DiGraph() if directed else nx.Graph()
    graph.add_nodes_from(TOWNS)
    links = [("Ulm", "Bonn", 0.5), ("Kiel", "Bonn", 2.0), ("Jena", "Kiel", 1.0), ("Bonn", "Jena", 1.25)]
    graph.add_weighted_edges_from(links)
    return graph


def listens(graph: Any, nodes: list[Any]) -> Any:
    """(m, m): row i has the weights with which agent i listens; networkx has the sources in rows."""
    return nx.to_numpy_array(graph, nodelist=nodes).T


def write_csv(graph: Any, file: Path, kind: str | None = None) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["source", "target", "weight"] + ["type"] * (kind is not None))
        writer.writerows([a, b, w] + [kind] * (kind is not None) for a, b, w in graph.edges(data="weight"))


def parsed(graphs: dict[str, Any], directory: Path | None = None, **others: Any) -> Experiment:
    rates = {"rates": {a: {b: 1.0 for b in graphs if b != a} for a in graphs}} if len(graphs) > 1 else {}
    return Experiment.parse({"name": "net", "graphs": graphs, "switching": rates} | others, directory=directory)


def mistakes(graphs: dict[str, Any], directory: Path | None = None, **others: Any) -> list[str]:
    with pytest.raises(ExperimentError) as caught:
        parsed(graphs, directory, **others)
    return caught.value.problems


@pytest.mark.parametrize("directed", [False, True])
def test_the_same_graph_in_every_way(directed: bool, tmp_path: Path) -> None:
    """All equal to what networkx has, with its names in its order, and without the files once they are read."""
    graph = towns(directed)
    nx.write_graphml(graph, tmp_path / "net.graphml")
    write_csv(graph, tmp_path / "net.csv", None if directed else "Undirected")
    expected = listens(graph, TOWNS)
    graphs = {"a": {"graphml": "net.graphml"}, "b": {"csv": "net.csv"}, "c": graph}
    graphs |= {"d": {"adjacency": expected.tolist()}, "e": {"adjacency": expected}}
    experiment = parsed(graphs, tmp_path)
    assert experiment.names == TOWNS
    for made in experiment.graph_list:
        assert np.array_equal(made.adjacency, expected), made.name
        assert made.symmetric != directed
    for file in tmp_path.iterdir():
        file.unlink()
    assert Experiment.parse(json.loads(json.dumps(experiment.to_document()))) == experiment
    kind = "arcs" if directed else "edges"
    assert [list(each) for each in experiment.to_document()["graphs"].values()] == [[kind]] * 5


def test_the_target_listens_to_the_source(tmp_path: Path) -> None:
    """By hand, as `arcs` have it: 2 listens to 1."""
    (tmp_path / "net.csv").write_text("\ufeffSource, Target\n1, 2\n\n3, 1\n", encoding="utf-8")
    adjacency = [[0, 0, 1], [1, 0, 0], [0, 0, 0]]
    graphs = {"a": {"csv": "net.csv"}, "b": {"arcs": [[1, 2], [3, 1]]}, "c": {"adjacency": adjacency}}
    graphs["d"] = nx.DiGraph([(1, 2), (3, 1)])
    experiment = parsed(graphs, tmp_path)
    assert experiment.names is None
    for made in experiment.graph_list:
        assert made.adjacency.tolist() == adjacency


def test_edges_and_arcs_in_one_file(tmp_path: Path) -> None:
    """Whose place is relative to that of the experiment."""
    (tmp_path / "net.csv").write_text("source,target,type,weight\na,b,directed,2\nb,c,undirected,\nc,a,,0.5\n")
    (tmp_path / "file.yaml").write_text("name: net\ngraphs: {net: {csv: net.csv}}\n")
    adjacency = Experiment.load(tmp_path / "file.yaml").graph_list[0].adjacency
    assert adjacency.tolist() == [[0, 0, 0.5], [2, 0, 1], [0, 1, 0]]


def test_the_same_name_is_the_same_agent(tmp_path: Path) -> None:
    """In whatever order the graphs have them; each graph need not have all."""
    ring = nx.cycle_graph(["Jena", "Bonn", "Kiel"])
    nx.write_graphml(ring, tmp_path / "ring.graphml")
    line = nx.path_graph(TOWNS)
    experiment = parsed({"line": line, "ring": {"graphml": "ring.graphml"}}, tmp_path)
    assert experiment.names == TOWNS
    ring.add_nodes_from(TOWNS)
    assert np.array_equal(experiment.graph_list[1].adjacency, nx.to_numpy_array(ring, nodelist=TOWNS))


def test_names_give_the_order() -> None:
    names = sorted(TOWNS)
    experiment = parsed({"net": towns(False), "line": {"path": [1, 2, 3, 4]}}, names=names)
    assert experiment.names == names
    assert np.array_equal(experiment.graph_list[0].adjacency, nx.to_numpy_array(towns(False), nodelist=names))
    assert parsed({"line": {"path": [1, 2]}}, names=["b", "a"]).names == ["b", "a"]
    assert parsed({"star": {"star": {"center": 1}}}, names=TOWNS).agents == 4


def test_whole_numbers_are_numbers() -> None:
    """Counted from 0 or from 1, by what all graphs together have; the order in which nodes were added means nothing."""
    from_0 = nx.Graph([(2, 0), (0, 1)])
    rest = nx.Graph([(1, 2)])
    experiment = parsed({"a": from_0, "b": rest})
    assert experiment.names is None
    assert np.array_equal(experiment.graph_list[0].adjacency, nx.to_numpy_array(from_0, nodelist=range(3)))
    assert experiment.graph_list[1].edges == [(2, 3, 1.0)]
    assert parsed({"a": nx.Graph([(3, 1), (1, 2)])}).graph_list[0].edges == [(1, 2, 1.0), (1, 3, 1.0)]


def test_leaders_by_name() -> None:
    tracking = {"problem": "tracking", "leaders": {"agents": ["Kiel", 1]}}
    experiment = parsed({"net": towns(False)}, **tracking)
    assert experiment.spec.leaders
    assert experiment.spec.leaders.agents == [3, 1]
    tracking["leaders"] = {"agents": ["Köln"]}
    (line,) = mistakes({"net": towns(False)}, **tracking)
    assert line == 'leaders.agents: "Köln": expected one of the names Ulm, Bonn, Kiel, Jena: correct it'
    (line,) = mistakes({"net": {"path": [1, 2]}}, **tracking)
    assert line == 'leaders.agents: "Köln": expected a number, since no agent is named: correct it'


def test_names_change_no_number() -> None:
    """Not of a run, of its law, or of its record, in which they are."""
    named = parsed({"net": towns(False)}, run={"duration": 1, "replicas": 2})
    document = named.to_document()
    assert document.pop("names") == TOWNS
    plain = Experiment.parse(document)
    assert np.array_equal(named.simulate().states, plain.simulate().states)
    assert law_identity(named) == law_identity(plain)
    record = named.simulate().record
    assert RunRecord.from_json(record.to_json(), "record").experiment.names == TOWNS


CSV = [
    ("", "empty: expected the columns source,target[,weight][,type], separated by commas"),
    ("a,b\n", 'line 1: "a,b": expected the columns source,target'),
    ("source;target\n1;2\n", 'line 1: "source;target": expected the columns'),
    ("source,target,wieght\n1,2,3\n", "expected the columns"),
    ("source,target\n", "expected rows below the header: add one for each link"),
    ("source,target\na,b\na\n", 'line 3: "a": expected 2 values as in the header: correct the line'),
    ("source,target\na,\n", 'line 2: target "": expected a node\'s name'),
    ("source,target,weight\na,b,x\n", 'line 2: weight "x": expected a number > 0: correct the line'),
    ("source,target,weight\na,b,nan\n", 'line 2: weight "nan": expected a number > 0'),
    ("source,target,weight\na,b,-1\n", 'line 2: weight "-1": expected a number > 0'),
    ("source,target,type\na,b,mutual\n", 'line 2: type "mutual": expected directed or undirected'),
    ("source,target\na,a\n", '["a", "a"]: agent a is linked with itself: remove the self-loop'),
    ("source,target\na,b\nb,a\na,b\n", '["a", "b"]: expected every arc once'),
]


@pytest.mark.parametrize(("text", "words"), CSV)
def test_a_csv_file_with_a_mistake(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "net.csv").write_text(text)
    (line,) = mistakes({"net": {"csv": "net.csv"}}, tmp_path)
    assert line.startswith("graphs.net.csv: ")
    assert words in line


@pytest.mark.parametrize("content", ["not xml", "<xml/>", "<graphml><graph/></graphml>", ""])
def test_graphml_that_is_none(content: str, tmp_path: Path) -> None:
    (tmp_path / "net.graphml").write_text(content)
    (line,) = mistakes({"net": {"graphml": "net.graphml"}}, tmp_path)
    assert line.startswith("graphs.net.graphml: ")
    assert "net.graphml" in line


def test_files_that_are_not_there_or_not_text(tmp_path: Path) -> None:
    (tmp_path / "net.csv").write_bytes(b"source,target\n\xff\xfe,a\n")
    assert "expected a CSV file in UTF-8" in mistakes({"net": {"csv": "net.csv"}}, tmp_path)[0]
    assert mistakes({"net": {"csv": "no.csv"}}, tmp_path)[0].endswith("relative to the experiment file")
    for kind in ("csv", "graphml"):
        assert "/dev/zero: cannot be read: longer than 64 MB" in mistakes({"net": {kind: "/dev/zero"}})[0]


@pytest.mark.parametrize(
    ("graphs", "others", "words"),
    [
        ({"net": {"adjacency": [[0, 1], [1]]}}, {}, "graphs.net.adjacency: 2 rows of 1 or 2 entries: expected a sq"),
        ({"net": {"adjacency": [[0, 1], [1, 2]]}}, {}, "graphs.net.adjacency[2][2]: 2.0: expected 0 on the diagonal"),
        ({"net": {"adjacency": [[0, -1], [1, 0]]}}, {}, "graphs.net.adjacency[1][2]: -1: expected a number >= 0"),
        ({"net": {"adjacency": [[0, "x"], [1, 0]]}}, {}, 'graphs.net.adjacency[1][2]: "x": expected a number'),
        ({"net": nx.MultiGraph([("a", "b")])}, {}, "graphs.net: a MultiGraph: expected a networkx.Graph or"),
        ({"net": nx.Graph()}, {}, "graphs.net: a graph without nodes: expected a graph with nodes"),
        ({"net": nx.Graph([("", "b")])}, {}, 'graphs.net: node "": expected a node\'s name'),
        ({"net": nx.Graph([("1", 1)])}, {}, 'graphs.net: node "1" twice: expected different names'),
        ({"net": nx.Graph([("a", "b", {"weight": -1})])}, {}, "graphs.net: weight -1 of a - b: expected a weight > 0"),
        ({"net": nx.Graph([("a", "a"), ("a", "b")])}, {}, 'graphs.net: ["a", "a"]: agent a is linked with itself'),
        ({"net": nx.Graph([("a", "b")])}, {"agents": 3}, "names: 2 names from the files of the graphs: expected"),
        ({"net": {"path": [1, 2, 3]}}, {"names": ["a", "b"]}, "names: 2 names: expected one for each of the 3 agents"),
        ({"net": {"path": [1, 2]}}, {"names": ["a", "a"]}, 'names: "a": expected different names: rename one'),
        ({"net": {"path": [1, 2]}}, {"names": ["a", " b"]}, 'names[2]: " b": expected a name of the form'),
        ({"net": nx.Graph([("a", "b")])}, {"names": ["a", "c"]}, 'graphs.net: node "b": expected one of the names a'),
        ({"net": nx.Graph({"a": ["b"], "c": []})}, {}, "graphs: agent c cannot be reached from agents a, b in"),
    ],
)
def test_a_graph_with_a_mistake(graphs: dict[str, Any], others: dict[str, Any], words: str) -> None:
    (line,) = mistakes(graphs, **others)
    assert line.startswith(words)
