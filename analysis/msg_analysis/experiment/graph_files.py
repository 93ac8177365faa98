# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Graphs from GraphML, CSV and matrix files: what other programs write is read, or is refused, or stands in a note."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from msg_analysis.common.files import read_bytes
from msg_analysis.common.text import counted, listed
from msg_analysis.experiment.problems import problem, show
from msg_analysis.experiment.values import NAME_PATTERN, is_number

_NODE = f"expected a node's name of the form {NAME_PATTERN.strip('^$')}"
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_COMMA = re.compile(r"([-+]?[0-9]*),([0-9]+(?:[eE][-+]?[0-9]+)?)")  # a number with a decimal comma
_THOUSANDS = re.compile(r"[1-9][0-9]{0,2},[0-9]{3}")
_SHORTENED = re.compile(r"[0-9]([.,][0-9]+)?[eE]\+[0-9]+")
_MADE = re.compile("n[0-9]+")  # ids of igraph, yEd, graph-tool and others


@dataclass(frozen=True, slots=True)
class ForeignGraph:
    """A graph with the nodes of its source, as texts, in their order."""

    nodes: Sequence[str]
    links: Sequence[tuple[str, str, float]]  # of a directed one: source, target, weight
    directed: bool
    notes: Sequence[str] = ()  # what of the source is not in the graph, or might be understood in another way
    made_ids: bool = False  # whether the nodes have no names but numbers of a program

    def joined(self, parallel: str | None) -> ForeignGraph:
        """The same with one link in place of parallel ones: "sum" of their weights, or the "first"; None: all."""
        weights: dict[tuple[str, str], float] = {}
        for source, target, weight in self.links if parallel else ():
            back = not self.directed and (target, source) in weights
            pair = (target, source) if back else (source, target)
            weights[pair] = weights.get(pair, 0.0) + weight if parallel == "sum" else weights.get(pair, weight)
        return replace(self, links=[(*pair, weight) for pair, weight in weights.items()]) if parallel else self


class GraphError(Exception):
    """One mistake in a graph from elsewhere: key, value, what was expected and what to do, as of ``problem``."""

    def __init__(self, key: str, value: object, wanted: str, remedy: str) -> None:
        super().__init__(problem(key, value, wanted, remedy))


def node_name(key: str, node: object, remedy: str = "rename it") -> str:
    """The text of a node; 3.0, to which spreadsheets change the number 3, is 3. GraphError: it is no name."""
    name = str(node).strip()
    if _SHORTENED.fullmatch(name):
        wanted = "expected a whole number or a name, not a number whose last digits are gone"
        raise GraphError(key, f"node {show(name)}", wanted, "export it again, as text")
    if not re.match(NAME_PATTERN, name):
        raise GraphError(key, f"node {show(str(node))}", _NODE, remedy)
    return re.sub(r"^([0-9]+)\.0*$", r"\1", name)


def require_different(key: str, names: Iterable[str]) -> None:
    """GraphError: two nodes of a graph have the same name."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise GraphError(key, f"node {show(min(twice))} twice", "expected different names", "rename one")


def _value(value: object) -> float | None:
    """The number that a value or text is; None for everything else."""
    if isinstance(value, str):
        value = float(value) if _NUMBER.fullmatch(value.strip()) else None
    elif isinstance(value, np.generic):
        value = value.item()
    return float(value) if is_number(value) else None


def weights_of(key: str, links: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[list[float], list[str]]:
    """The weight of each link, of which the place and the attributes are given, and notes on what is not read."""
    names = dict.fromkeys(name for _, attributes in links for name in attributes)
    found = [name for name in names if name.strip().lower() == "weight"]
    if len(found) > 1:
        raise GraphError(key, " and ".join(found), "expected one weight", "remove the others")
    if not found:
        others = [name for name in names if _is_quantity(name, [given.get(name, "") for _, given in links])]
        note = f"no `weight`, so every link has 1; not read: {listed(others)}"
        return [1.0] * len(links), [note] if others else []
    weights, without = [], 0
    for place, attributes in links:
        given = attributes.get(found[0], "")
        without += given == ""
        weight = 1.0 if given == "" else _value(given)
        if weight is None or weight <= 0:
            raise GraphError(key, f"{place}weight {show(given)}", "expected a number > 0", "correct it")
        weights.append(weight)
    note = f"{counted(without, 'link')} of {len(links)} without a weight: 1"
    return weights, [note] if without else []


def _is_quantity(name: str, values: Sequence[object]) -> bool:
    """Whether an attribute of links, which is no number of the link itself, has numbers only."""
    given = [value for value in values if value != ""]
    counts = name.strip().lower() in ("", "id", "key", "index") or name.startswith("Unnamed")
    return bool(given) and not counts and all(_value(value) is not None for value in given)


def file_content(key: str, file: Path) -> bytes:
    """The bytes of a file of bounded size; ``key`` is for the GraphError."""
    if file.exists() and not file.is_file():  # a pipe or terminal would be waited for
        raise GraphError(key, str(file), "not a regular file", "give the path of a file")
    try:
        return read_bytes(file)
    except FileNotFoundError as error:
        raise GraphError(key, str(file), "no such file", "the path is relative to the experiment file") from error
    except (OSError, ValueError) as error:  # ValueError: a zero byte in its name
        raise GraphError(key, show(str(file)), "cannot be read", getattr(error, "strerror", str(error))) from error


def _tree(key: str, file: Path) -> Element:
    """The elements of an XML file by their local names. Not by networkx, which leaves out or refuses too much."""
    try:
        root = ElementTree.fromstring(file_content(key, file))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise GraphError(key, str(file), f"expected a GraphML file ({error})", "export it again") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root


def read_graphml(key: str, file: Path) -> ForeignGraph:
    """The graph of a GraphML file; ``key`` is for the GraphError."""
    root = _tree(key, file)
    graphs = root.findall("graph")
    if root.tag != "graphml" or len(graphs) != 1 or next(root.iter("hyperedge"), None) is not None:
        counts = f"{len(graphs)} graphs, {len(list(root.iter('hyperedge')))} hyperedges"
        shown = f"{file}: {counts if root.tag == 'graphml' else f'<{root.tag}>'}"
        raise GraphError(key, shown, "expected a GraphML file with one graph of nodes and edges", "export it again")
    known = {kind: _Attributes(root, kind) for kind in ("node", "edge")}
    found = [(element.get("id", ""), element) for element in graphs[0].iter("node")]
    ends, links, arcs = set(), [], []
    notes: list[str] = []
    for graph in graphs[0].iter("graph"):
        default = graph.get("edgedefault", "").lower()
        for edge in graph.findall("edge"):
            source, target = edge.get("source", ""), edge.get("target", "")
            links.append((source, target, known["edge"].of(edge)))
            arcs.append({"true": True, "false": False}.get(edge.get("directed", ""), default == "directed"))
            ends |= {source, target}
            if default not in ("directed", "undirected") and not notes and edge.get("directed") is None:
                notes.append("no `edgedefault`: its edges are read as undirected")
    groups = [node for node, element in found if element.find("graph") is not None and node not in ends]
    if groups:
        notes.append(f"groups without links of their own are no agents: {listed(groups)}")
    nodes = [(node, known["node"].of(element)) for node, element in found if node not in groups]
    if not nodes:
        raise GraphError(key, str(file), "expected a graph with nodes", "export it again")
    require_different(key, [node for node, _ in nodes])
    if unknown := sorted(ends - {node for node, _ in nodes}):
        raise GraphError(key, f"{file}: edge of node {show(unknown[0])}", "expected nodes of the file", "correct it")
    names, more = _names(nodes)
    made = not names and (bool(more) or all(_MADE.fullmatch(node) for node, _ in nodes))
    names = names or {node: node_name(key, node) for node, _ in nodes}
    require_different(key, names.values())
    weights, others = weights_of(key, [(f"{names[a]} - {names[b]}: ", given) for a, b, given in links])
    ordered = sorted(names, key=int) if all(map(is_whole, names)) else names
    named = [(names[a], names[b], weight) for (a, b, _), weight in zip(links, weights, strict=True)]
    return _graph([names[node] for node in ordered], named, arcs, notes + more + others, made)


class _Attributes:
    """The attributes of the nodes or edges of a GraphML file, by the names that its keys have."""

    def __init__(self, root: Element, kind: str) -> None:
        keys = [key for key in root.iter("key") if key.get("for", "all") in (kind, "all")]
        self._names = {key.get("id", ""): key.get("attr.name", key.get("id", "")) for key in keys}
        defaults = {self._names[key.get("id", "")]: (key.findtext("default") or "").strip() for key in keys}
        self._defaults = {name: text for name, text in defaults.items() if text}

    def of(self, element: Element) -> dict[str, str]:
        """Those of a node or an edge; what a program draws as its text is a label."""
        found = dict(self._defaults)
        for data in element.findall("data"):
            drawn = [each.text or "" for each in data.iter() if each.tag in ("NodeLabel", "EdgeLabel", "Label.Text")]
            name = self._names.get(data.get("key", ""), data.get("key", ""))
            if len(data) and drawn:
                found.setdefault("label", drawn[0].strip())
            elif not len(data) and (text := (data.text or "").strip()):
                found[name] = text
        return found


def _names(nodes: Sequence[tuple[str, Mapping[str, str]]]) -> tuple[dict[str, str], list[str]]:
    """The names of nodes by id, from an attribute that names each differently; none, and why, where there is none."""
    notes = []
    for wanted in ("name", "label"):
        given = [
            (node, " ".join(text.split()))
            for node, attributes in nodes
            for attribute, text in attributes.items()
            if attribute.lower() == wanted and text.strip()
        ]
        names, most = dict(given), Counter(name for _, name in given).most_common(1)
        if len(nodes) == len(given) == len(set(names.values())) and all(
            re.match(NAME_PATTERN, n) for n in names.values()
        ):
            return {node: node_name("", name) for node, name in given}, []
        if given:
            missing = "cannot be a name"
            if len(names) < len(nodes):
                missing = f"is missing at {counted(len(nodes) - len(names), 'node')}"
            elif most[0][1] > 1:
                missing = f"is {show(most[0][0])} {most[0][1]} times"
            notes.append(f"the nodes are called by their ids, since their {wanted} {missing}")
    return {}, notes


def is_whole(node: str) -> bool:
    """Whether a node is a whole number."""
    return node.isascii() and node.isdigit()


def _graph(
    nodes: Sequence[str], links: list[tuple[str, str, float]], arcs: Sequence[bool], notes: list[str], made_ids: bool
) -> ForeignGraph:
    """The graph of links of which some have a direction, ``arcs``; the others are then arcs both ways."""
    directed = any(arcs)
    back = [(b, a, weight) for (a, b, weight), arc in zip(links, arcs, strict=True) if directed and not arc]
    return ForeignGraph(nodes, links + back, directed, notes, made_ids)


_ENDS = (("source", "target"), ("from", "to"))
_KINDS = {"directed", "undirected", "mutual", ""}
_COLUMNS = "expected the columns source,target[,weight][,type], separated by commas, semicolons or tabs"


def read_csv(key: str, file: Path) -> ForeignGraph:
    """The edge list of a CSV file with a header, rows are arcs or edges; ``key`` is for the GraphError."""
    separator, table = _table(key, file)
    names, rows = table[0][1], table[1:]
    head = [name.lower() for name in names]
    ends = next((pair for pair in _ENDS if set(pair) <= set(head)), None)
    if ends is None or any(head.count(name) > 1 for name in (*ends, "weight", "type")):
        place = f"{file}, line {table[0][0]}: {show(separator.join(names))}"
        raise GraphError(key, place, _COLUMNS, "correct the header")
    if not rows:
        raise GraphError(key, str(file), "expected rows below the header", "add one for each link")
    if separator != ",":
        _set_points(key, file, separator, rows, [head.index(name) for name in (*ends, "weight") if name in head])
    kinds = {row[place].lower() for _, row in rows for place, name in enumerate(head[: len(row)]) if name == "type"}
    notes = []
    if kinds and not kinds & _KINDS:
        head[head.index("type")] = ""
        notes = ["`type` is not about directions, so rows are arcs"]
    needed = max(place for place, name in enumerate(head) if name in (*ends, "weight", "type"))
    pairs, arcs, attributes, known = [], [], [], dict[str, str]()
    for line, row in rows:
        place = f"{file}, line {line}: "
        if len(row) <= needed or any(row[len(head) :]):
            shown = place + show(separator.join(row))
            raise GraphError(key, shown, f"expected {len(head)} values as in the header", "correct the line")
        cells = dict(zip(head, row, strict=False))
        for end in ends:
            if (node := cells[end]) not in known:
                known[node] = node_name(f"{key}: {place}{end}", node, "correct the line")
        kind = cells.get("type", "").lower() or "directed"
        if kind not in ("directed", "undirected"):
            shown = f"{place}type {show(cells['type'])}"
            raise GraphError(key, shown, "expected directed or undirected", "correct the line")
        pairs.append((known[cells[ends[0]]], known[cells[ends[1]]]))
        arcs.append(kind == "directed")
        others = {n: cell for n, cell in zip(names, row, strict=False) if n.lower() not in (*ends, "type")}
        attributes.append((place, others))
    weights, more = weights_of(key, attributes)
    nodes = list(dict.fromkeys(node for pair in pairs for node in pair))
    links = [(*pair, weight) for pair, weight in zip(pairs, weights, strict=True)]
    return _graph(nodes, links, arcs, notes + more, all(map(_MADE.fullmatch, nodes)))


def _table(key: str, file: Path) -> tuple[str, list[tuple[int, list[str]]]]:
    """The separator of a CSV file, and its rows that are not empty, the header first, with their lines."""
    content = file_content(key, file)
    utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if utf_16 else "utf-8-sig")
        text = re.sub(r"\Asep=.\r?\n", "\n", text)  # by which a file tells Excel its separator
        for separator in (";", "\t", ","):
            rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
            table = ((rows.line_num, [cell.strip() for cell in row]) for row in rows)
            table = ((line, row) for line, row in table if any(row))
            first = next(table, None)
            if first and any(set(ends) <= {name.lower() for name in first[1]} for ends in _ENDS):
                break
        if first:
            return separator, [first, *table]
    except (UnicodeDecodeError, csv.Error) as error:
        raise GraphError(key, str(file), f"expected a CSV file in UTF-8 ({error})", "export it again") from error
    raise GraphError(key, str(file), f"empty: {_COLUMNS}", "write them into its first line")


def _set_points(
    key: str, file: Path, separator: str, rows: Sequence[tuple[int, list[str]]], columns: Sequence[int]
) -> None:
    """Points in place of decimal commas in these columns; GraphError where commas may mean something else."""
    places = [(row, column) for _, row in rows for column in columns if column < len(row)]
    commas = [(row, column) for row, column in places if _COMMA.fullmatch(row[column])]
    points = [row[column] for row, column in places if "." in row[column] and _NUMBER.fullmatch(row[column])]
    thousands = separator == "\t" and all(_THOUSANDS.fullmatch(row[column]) for row, column in commas)
    if commas and (points or thousands):
        row, column = commas[0]
        shown = f"{file}: {', '.join([show(row[column]), *map(show, points[:1])])}"
        raise GraphError(key, shown, "expected to know whether the comma is a decimal one", "write decimal points")
    for row, column in commas:
        row[column] = row[column].replace(",", ".")


def read_matrix(key: str, file: Path) -> list[list[float]]:
    """The rows of a matrix in a file, .csv or .npy; ``key`` is for the GraphError."""
    content = file_content(key, file)
    try:
        if file.suffix == ".npy":
            matrix = np.load(io.BytesIO(content), allow_pickle=False)
        else:
            text = content.decode("utf-8-sig")
            text = text.replace(",", ".").replace(";", ",") if ";" in text else text  # spreadsheets with decimal commas
            matrix = np.loadtxt(io.StringIO(text), delimiter="\t" if "\t" in text else ",", ndmin=2)
        matrix = np.asarray(matrix, dtype=float)
    except (ValueError, TypeError, EOFError) as error:
        reason = " ".join(str(error).split())
        raise GraphError(key, str(file), f"expected a matrix of numbers ({reason})", "correct it") from None
    if matrix.ndim != 2 or len(matrix) < 2 or not np.isfinite(matrix).all() or matrix.min() < 0.0:
        shape = " x ".join(map(str, matrix.shape))
        wanted = "expected a square matrix of finite numbers >= 0"
        raise GraphError(key, f"{file}: {shape}", wanted, "row i has the weights with which agent i listens")
    rows: list[list[float]] = matrix.tolist()
    return rows
