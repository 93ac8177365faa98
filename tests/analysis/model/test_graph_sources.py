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
    ("", "empty: expected the columns source,target[,weight][,type], separated by commas, semicolons or tabs"),
    ("a,b\n", 'line 1: "a,b": expected the columns source,target'),
    ("source,goal\n1,2\n", 'line 1: "source,goal": expected the columns'),
    ("source,target,Source\n1,2,3\n", "expected the columns"),
    ("source\ttarget\tweight\n1\t2\t1,234\n", "expected to know whether the comma is a decimal one"),
    ("source;target;weight\n1;2;1.234,5\n", 'line 2: weight "1.234,5": expected a number > 0'),
    ("source;target;weight\n1;2;0,5\n2;3;1.234\n", "expected to know whether the comma is a decimal one"),
    ("source,target\n2.45E+11,2.46E+11\n", 'line 2: source: node "2.45E+11": expected a whole number or a name'),
    ("source,target,weight,Weight\n1,2,3,4\n", "expected the columns"),
    ("source,target,type\na,b,directed\nb,c,other\n", 'line 3: type "other": expected directed or undirected'),
    ("source,target\n", "expected rows below the header: add one for each link"),
    ("source,target\na,b\na\n", 'line 3: "a": expected 2 values as in the header: correct the line'),
    ("source,target\na,\n", 'line 2: target: node "": expected a node\'s name'),
    ("source,target,weight\na,b,x\n", 'line 2: weight "x": expected a number > 0: correct it'),
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


def graphml(nodes: str, edges: str, keys: str = "", default: str = "undirected") -> str:
    graph = f'<graph edgedefault="{default}">{nodes}{edges}</graph>'
    return f'<graphml xmlns="http://graphml.graphdrawing.org/xmlns" xmlns:y="y">{keys}{graph}</graphml>'


def edge(source: object, target: object, data: object = "", more: str = "") -> str:
    return f'<edge source="{source}" target="{target}" {more}><data key="w">{data}</data></edge>'


NAMED = {  # how programs write the names of nodes beside their ids
    "igraph": ('<key id="v" for="node" attr.name="name" attr.type="string"/>', '<data key="v">{}</data>'),
    "Topology Zoo": ('<key id="v" for="node" attr.name="label" attr.type="string"/>', '<data key="v">{}</data>'),
    "capitals": ('<key id="v" for="all" attr.name="Label" attr.type="string"/>', '<data key="v"> {}\n</data>'),
    "yEd": (
        '<key id="v" for="node" yfiles.type="nodegraphics"/>',
        '<data key="v"><y:ShapeNode><y:Fill/><y:NodeLabel>{}<y:Model/></y:NodeLabel></y:ShapeNode></data>',
    ),
    "yEd, rare shape": (
        '<key id="v" for="node" yfiles.type="nodegraphics"/>',
        '<data key="v"><y:TableNode><y:NodeLabel>{}</y:NodeLabel></y:TableNode></data>',
    ),
}


@pytest.mark.parametrize("program", NAMED)
@pytest.mark.parametrize("made", ["n{}", "{}", "n0::n{}"])
def test_nodes_are_the_same_by_their_names_not_by_their_ids(program: str, made: str, tmp_path: Path) -> None:
    """A line of four towns in two orders: the same graph, as networkx has it."""
    key, data = NAMED[program]
    for file, order in (("a", TOWNS), ("b", sorted(TOWNS))):
        ids = {town: made.format(number) for number, town in enumerate(order)}
        nodes = "".join(f'<node id="{ids[town]}">{data.format(town)}</node>' for town in order)
        edges = "".join(edge(ids[a], ids[b]) for a, b in nx.path_graph(TOWNS).edges)
        (tmp_path / f"{file}.graphml").write_text(graphml(nodes, edges, key))
    experiment = parsed({name: {"graphml": f"{name}.graphml"} for name in "ab"}, tmp_path)
    assert (experiment.names, experiment.notes) == (TOWNS, ())
    for graph in experiment.graph_list:
        assert np.array_equal(graph.adjacency, nx.to_numpy_array(nx.path_graph(TOWNS), nodelist=TOWNS))


def test_nodes_without_different_names_are_noted(tmp_path: Path) -> None:
    """Of ids that a program made, two files mean different nodes; whether they do cannot be known."""
    key, data = NAMED["igraph"]
    nodes = "".join(f'<node id="n{i}">{data.format(name)}</node>' for i, name in enumerate(["Ulm", "Ulm", "Kiel"]))
    (tmp_path / "a.graphml").write_text(graphml(nodes, edge("n0", "n1") + edge("n1", "n2"), key))
    (tmp_path / "b.csv").write_text("source,target\nn0,n1\nn2,n0\n")
    experiment = parsed({"a": {"graphml": "a.graphml"}, "b": {"csv": "b.csv"}}, tmp_path)
    assert experiment.names == ["n0", "n1", "n2"]
    first, second = experiment.notes
    assert first == 'graphs.a.graphml: the nodes are called by their ids, since their name is "Ulm" 2 times'
    assert second.startswith("graphs.a.graphml, graphs.b.csv: the nodes have no names that are all different")


WEIGHT = '<key id="w" for="edge" attr.name="weight" attr.type="{}">{}</key>'
THREE = "".join(f'<node id="{i}"/>' for i in (1, 2, 3))
READ = [  # keys, edges, the weights of 1-2 and 2-3, what a note says
    (WEIGHT.format("double", "<default>2.5</default>"), edge(1, 2, 4) + edge(2, 3), [4, 2.5], None),
    (WEIGHT.format("string", ""), edge(1, 2, " 4 ") + edge(2, 3, "5e-1"), [4, 0.5], None),
    (WEIGHT.format("vector_double", ""), edge(1, 2, 4) + edge(2, 3, 5), [4, 5], None),
    (WEIGHT.format("double", ""), edge(1, 2, 4) + edge(2, 3), [4, 1], "1 link of 2 without a weight: 1"),
    (WEIGHT.format("double", "").replace("weight", "Weight"), edge(1, 2, 4) + edge(2, 3, 5), [4, 5], None),
    (WEIGHT.format("double", "").replace("weight", "cost"), edge(1, 2, 4) + edge(2, 3, 5), [1, 1], "not read: cost"),
    (WEIGHT.format("string", "").replace("weight", "kind"), edge(1, 2, "a") + edge(2, 3, "b"), [1, 1], None),
    (
        '<key id="w" for="edge" yfiles.type="edgegraphics"/>',
        edge(1, 2, "<y:Line><y:EdgeLabel>4</y:EdgeLabel></y:Line>") + edge(2, 3),
        [1, 1],
        "every link has 1; not read: label",
    ),
    ('<key id="p" for="node" attr.name="pos" attr.type="vector_double"/>', edge(1, 2) + edge(2, 3), [1, 1], None),
    (
        "",
        edge(1, 2) + f'<node id="4"><graph edgedefault="undirected">{edge(3, 2)}</graph></node>',
        [1, 1],
        "no agents: 4",
    ),
]


@pytest.mark.parametrize(("keys", "edges", "weights", "note"), READ)
def test_what_graphml_files_have_is_read_or_noted(
    keys: str, edges: str, weights: list[float], note: str | None, tmp_path: Path
) -> None:
    (tmp_path / "net.graphml").write_text(graphml(THREE, edges, keys))
    experiment = parsed({"net": {"graphml": "net.graphml"}}, tmp_path)
    assert [weight for *_, weight in experiment.graph_list[0].edges] == weights
    assert len(experiment.notes) == (note is not None)
    assert (note or "") in "".join(experiment.notes)


def test_directions_of_single_edges(tmp_path: Path) -> None:
    (tmp_path / "net.graphml").write_text(graphml(THREE, edge(1, 2, more='directed="true"') + edge(2, 3)))
    assert parsed({"net": {"graphml": "net.graphml"}}, tmp_path).graph_list[0].arcs == [(1, 2, 1), (3, 2, 1), (2, 3, 1)]


BOMB = '<!ENTITY b0 "aaaaaaaaaa">' + "".join(f'<!ENTITY b{i} "{f"&b{i - 1};" * 10}">' for i in range(1, 10))
REFUSED = [
    (f"<graphml><graph>{THREE}</graph><graph/></graphml>", "2 graphs, 0 hyperedges: expected a GraphML file with one"),
    (graphml(THREE, "<hyperedge/>"), "1 graphs, 1 hyperedges"),
    (graphml(THREE, edge(1, 9)), 'edge of node "9": expected nodes of the file'),
    (graphml(THREE + THREE, edge(1, 2)), 'node "1" twice'),
    (graphml(THREE, edge(1, 2, "x"), WEIGHT.format("string", "")), '1 - 2: weight "x": expected a number > 0'),
    (graphml(THREE, edge(1, 2, "1_0"), WEIGHT.format("int", "")), 'weight "1_0": expected a number > 0'),
    (f"<!DOCTYPE g [{BOMB}]><graphml>&b9;</graphml>", "expected a GraphML file (limit on input amplification factor"),
    ('<!DOCTYPE g [<!ENTITY a SYSTEM "file:///etc/passwd">]><graphml>&a;</graphml>', "undefined entity &a;"),
    ("<graphml>" * 100_000 + "</graphml>" * 100_000, "0 graphs, 0 hyperedges"),
    ("<gexf><graph/></gexf>", "<gexf>: expected a GraphML file"),
    ('<?xml version="1.0" encoding="nonsense"?><graphml/>', "expected a GraphML file (unknown encoding"),
]


@pytest.mark.parametrize(("content", "words"), REFUSED, ids=[words for _, words in REFUSED])
def test_graphml_that_is_refused(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "net.graphml").write_text(content)
    (line,) = mistakes({"net": {"graphml": "net.graphml"}}, tmp_path)
    assert line.startswith("graphs.net.graphml: ")
    assert words in line


TABLES = [  # text, the arcs (source, target, weight) of agents 1 and 2 in their order
    ("Source,Target,Type,Id,Label,timeset,Weight\n1,2,Directed,0,,,1.5\n", [(1, 2, 1.5)]),  # Gephi
    ("source;target;weight\n1;2;0,5\n2;1;1,5\n", [(2, 1, 1.5), (1, 2, 0.5)]),  # spreadsheets in German
    ("source;target;weight\n1,0;2,0;1,234\n", [(1, 2, 1.234)]),
    ("sep=;\r\nsource;target;weight\r\n1;2;0.5\r\n", [(1, 2, 0.5)]),
    ("source\ttarget\tweight\n1\t2\t0,5\n", [(1, 2, 0.5)]),
    ('"","from","to","weight"\n"1",1,2,0.5\n"2",2,1,4\n', [(2, 1, 4), (1, 2, 0.5)]),  # R
    (",source,target,weight\n0,1.0,2.0,3\n1,2.0,1.0,4.0\n", [(2, 1, 4), (1, 2, 3)]),  # pandas
    ("source,target,weight,\n1,2,3,\n", [(1, 2, 3)]),
    ("source,target,weight\n1,2,3,,\n", [(1, 2, 3)]),
    ("id,from,to,source of it\n7,1,2,book\n", [(1, 2, 1)]),
    ("Source,Target,Type,note\n1,2,Undirected\n", [(2, 1, 1), (1, 2, 1)]),
]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("text", "arcs"), TABLES)
def test_csv_files_of_programs(text: str, arcs: list[Any], encoding: str, tmp_path: Path) -> None:
    (tmp_path / "net.csv").write_bytes(text.encode(encoding))
    experiment = parsed({"net": {"csv": "net.csv"}}, tmp_path)
    assert experiment.graph_list[0].arcs == arcs
    assert (experiment.names, experiment.notes) == (None, ())


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ("source,target,wieght,name\n1,2,3,x\n", "no `weight`, so every link has 1; not read: wieght"),
        ("source,target,weight,value\n1,2,3,4\n2,1,,4\n", "1 link of 2 without a weight: 1"),
        ("from,to,weight,type\na,b,3,mention\n", "`type` is not about directions, so rows are arcs"),
        ("source,target\n501,502\n", "the nodes 501, 502 are not numbered from 1 to 2: these are the agents' names"),
    ],
)
def test_what_of_a_csv_file_is_noted(text: str, note: str, tmp_path: Path) -> None:
    (tmp_path / "net.csv").write_text(text)
    (found,) = parsed({"net": {"csv": "net.csv"}}, tmp_path).notes
    assert found.endswith(note)


OSM = [245_000_000_007, 245_000_000_001, 31]


@pytest.mark.parametrize("numbers", [[501, 502, 503], [2, 3, 5], OSM])
def test_numbers_that_are_not_of_agents_are_names(numbers: list[int], tmp_path: Path) -> None:
    """In ascending order; in the file of the experiment, too, a number is then the node of this name, or its text."""
    a, b, c = given = [number if 0 < number < 2**32 else str(number) for number in numbers]
    (tmp_path / "net.csv").write_text(f"source,target\n{a},{b}\n{b}.0,{c}\n{c},{a}\n")
    experiment = parsed(
        {"net": {"csv": "net.csv"}, "line": {"path": given}},
        tmp_path,
        problem="tracking",
        leaders={"agents": [b]},
        noise={"loss": {"arcs": [[a, b, 0.5]]}},
        run={"start": {c: 2.5}},
    )
    names = sorted(numbers)
    assert experiment.names == list(map(str, names))
    for graph, expected in zip(experiment.graph_list, (nx.cycle_graph, nx.path_graph), strict=True):
        there = expected(numbers, create_using=nx.DiGraph if graph.name == "net" else None)
        assert np.array_equal(graph.adjacency, nx.to_numpy_array(there, nodelist=names).T)
    assert experiment.leader_gains.tolist() == [float(str(number) == str(b)) for number in names]
    assert experiment.loss[names.index(numbers[1]), names.index(numbers[0])] == 0.5
    assert experiment.run.start == [2.5 * (number == numbers[2]) for number in names]
    assert Experiment.parse(experiment.to_document()) == experiment


def test_gaps_that_other_graphs_or_the_number_of_agents_fill(tmp_path: Path) -> None:
    (tmp_path / "net.csv").write_text("source,target\n1,2\n2,4\n")
    assert parsed({"a": {"csv": "net.csv"}, "b": {"path": [1, 3]}}, tmp_path).names is None
    assert "agent 3 cannot be reached" in mistakes({"a": {"csv": "net.csv"}}, tmp_path, agents=4)[0]
    tracking = {"problem": "tracking", "leaders": {"agents": [3]}}
    (line,) = mistakes({"a": {"csv": "net.csv"}}, tmp_path, **tracking)
    assert line == 'leaders.agents: "3": expected one of the names 1, 2, 4: correct it'


@pytest.mark.parametrize("kind", ["csv", "graphml"])
@pytest.mark.parametrize("directed", [False, True])
def test_parallel_links(kind: str, directed: bool, tmp_path: Path) -> None:
    """Their sum is what networkx makes of a multigraph."""
    graph = nx.MultiDiGraph() if directed else nx.MultiGraph()
    graph.add_weighted_edges_from([("a", "b", 0.5), ("b", "c", 1.0), ("a", "b", 2.0), ("c", "a", 1.0), ("b", "a", 4.0)])
    file = tmp_path / f"net.{kind}"
    write_csv(graph, file, None if directed else "Undirected") if kind == "csv" else nx.write_graphml(graph, file)
    (line, *_) = mistakes({"net": {kind: file.name}}, tmp_path)
    assert "or give `parallel: sum` or `parallel: first` beside the file" in line
    added = parsed({"net": {kind: file.name, "parallel": "sum"}}, tmp_path).graph_list[0]
    assert np.array_equal(added.adjacency, nx.to_numpy_array(graph, nodelist=list("abc")).T)
    first = parsed({"net": {kind: file.name, "parallel": "first"}}, tmp_path).graph_list[0]
    assert first.adjacency[1, 0] == 0.5
    assert first.adjacency[0, 1] == (4.0 if directed else 0.5)


def test_a_matrix_with_decimal_commas(tmp_path: Path) -> None:
    for text in ("0;0,5\n1;0\n", "0\t0.5\n1\t0\n", "0,0.5\n1,0\n"):
        (tmp_path / "net.csv").write_text(text)
        assert parsed({"net": {"adjacency": "net.csv"}}, tmp_path).graph_list[0].arcs == [(2, 1, 0.5), (1, 2, 1.0)]


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
        assert "/dev/zero: not a regular file" in mistakes({"net": {kind: "/dev/zero"}})[0]


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
        ({"net": nx.Graph([("a", "b", {"weight": -1})])}, {}, "graphs.net: a - b: weight -1: expected a number > 0"),
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
