"""Given sequences of graphs: recorded traces and schedules, against what their rows say at the time of every step."""

import csv
import random
from decimal import Decimal
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from msg_analysis.experiment import traces
from msg_analysis.experiment.experiment import Experiment, ExperimentError
from msg_analysis.model.graph_path import mode_path

DT = 0.1
NAMES = ["a", "b", "c", "d", "e"]
RING = [(NAMES[i], NAMES[(i + 1) % 5]) for i in range(5)]


def recorded(folder: Path, header: str, rows: list[Any], **keys: Any) -> Experiment:
    """Five agents with a trace of these rows; ``keys`` of ``switching``, and others of the experiment."""
    with (folder / "trace.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])
    others = {key: keys.pop(key) for key in ("graphs", "run") if key in keys}
    run = {"dt": DT} | others.pop("run", {})
    document = {"name": "net", "names": NAMES, "switching": {"trace": "trace.csv", **keys}, "run": run, **others}
    found = Experiment.parse(document, directory=folder)
    assert Experiment.parse(found.to_document()) == found  # without the file
    return found


def links(found: Experiment, step: int) -> dict[tuple[str, str], float]:
    """Source, target and weight of the links of a step."""
    arcs = found.graph_list[mode_path(found, np.empty(0))[step]].arcs
    return {(NAMES[s - 1], NAMES[t - 1]): weight for s, t, weight in arcs}


@pytest.mark.parametrize("undirected", [None, True])
@pytest.mark.parametrize("hold", [0.3, 1.0, 2.5])
def test_contacts(tmp_path: Path, hold: float, undirected: bool | None) -> None:
    """A link is there from a contact on until ``hold`` later."""
    rng = random.Random(f"contacts {hold}")
    rows = [(t / 10, *rng.sample(NAMES, 2)) for t in sorted(rng.choices(range(120), k=30))]
    rows = [(0.0, *pair) for pair in RING] + rows
    stamped = [(1_764_000_000 + Decimal(str(t)), *pair) for t, *pair in rows]
    found = recorded(tmp_path, "time,source,target", stamped, hold=hold, undirected=undirected, weight=0.5)
    assert found.steps == round((rows[-1][0] + hold) / DT)
    for k in range(found.steps):
        there = [(a, b) for time, a, b in rows if time - 1e-6 < k * DT < time + hold - 1e-6]
        there += [(b, a) for a, b in there] if undirected else []
        assert links(found, k) == dict.fromkeys(there, 0.5), k


def test_intervals(tmp_path: Path) -> None:
    """With weights, from a time of its own on, at any times: a link that no step falls into is in no step."""
    rng = random.Random(1)
    free = dict.fromkeys(RING, 1000.0)
    rows: list[tuple[float, float, str, str, float]] = [(1000.0, 1002.0, *pair, 1.0) for pair in RING]
    for begin in sorted(rng.uniform(1002.0, 1010.0) for _ in range(80)):
        pair = rng.choice(RING)
        if free[pair] < begin:
            free[pair] = begin + rng.uniform(0.001, 2.0)
            rows.append((begin, free[pair], *pair, rng.choice([0.5, 2.0])))
    found = recorded(tmp_path, "start,end,source,target,weight", rows)
    assert found.notes == ("switching.trace: time 0 of the run is 1000 in the file",)
    for k in range(found.steps):
        now = 1000.0 + k * DT
        assert links(found, k) == {(a, b): w for begin, end, a, b, w in rows if begin <= now + 1e-9 < end}, k


@pytest.mark.parametrize("hold", [None, 0.7])
@pytest.mark.parametrize("dimension", [2, 3])
def test_positions(tmp_path: Path, dimension: int, hold: float | None) -> None:
    """Agents are linked both ways within the radius; a position is valid until the next one, or for ``hold``."""
    rng = random.Random(f"positions {dimension} {hold}")
    rows = [(0.0, name, *(0.1 * i for _ in range(dimension))) for i, name in enumerate(NAMES)]
    for t in range(1, 30):
        rows += [(0.3 * t, name, *(rng.uniform(0, 3) for _ in range(dimension))) for name in rng.sample(NAMES, 3)]
    found = recorded(tmp_path, "time,agent,x,y,z"[: 14 + 2 * (dimension - 2)], rows, radius=1.5, hold=hold)
    for k in range(found.steps):
        places = {row[1]: row for row in rows if row[0] < k * DT + 1e-6}
        valid = [row for row in places.values() if k * DT < row[0] + (hold or 100.0) - 1e-6]
        near = nx.random_geometric_graph(len(valid), 1.5, dim=dimension, pos=dict(enumerate(row[2:] for row in valid)))
        wanted = {(valid[i][1], valid[j][1]): 1.0 for a, b in near.edges for i, j in ((a, b), (b, a))}
        assert links(found, k) == wanted, k


@pytest.mark.parametrize("written", ["file", "here"])
def test_schedules(tmp_path: Path, written: str) -> None:
    """Of named graphs, repeated; boundaries that are not times of steps belong to the next step."""
    graphs = {"line": {"path": NAMES}, "ring": {"cycle": NAMES}, "star": {"star": {"center": "a"}}}
    rows = [(0.0, "line"), (0.3, "ring"), (0.7, "line"), (1.15, "star")]
    keys = {"graphs": graphs, "repeat": True, "run": {"dt": DT, "duration": 12}}
    if written == "file":
        found = recorded(tmp_path, "time,graph", rows, hold=0.85, **keys)
    else:
        switching = {"schedule": rows, "end": 2.0, "repeat": keys.pop("repeat")}
        found = Experiment.parse({"name": "net", "names": NAMES, "switching": switching, **keys})
    for k, mode in enumerate(mode_path(found, np.empty(0)).tolist()):
        now = k * DT % 2.0 if k % 20 else 0.0
        assert found.graph_list[mode].name == [name for time, name in rows if time <= now + 1e-9][-1], k


CONTACTS = "time,source,target"
EPOCH = 1_764_000_000 * 10**9  # in nanoseconds


@pytest.mark.parametrize(
    ("header", "rows", "keys", "wanted"),
    [
        (CONTACTS, [(0, "a", "b"), (2, "b", "c"), (1, "c", "d")], {"hold": 1}, "line 4: time 1: expected at least 2"),
        (CONTACTS, [(0, "a", "b"), (1, "b", "x")], {"hold": 1}, "node \"x\": expected one of the names"),
        (CONTACTS, [(0, "a", "a")], {"hold": 1}, 'line 2: "a": expected two different agents'),
        (CONTACTS, [("nan", "a", "b")], {"hold": 1}, 'line 2: time "nan": expected a finite number'),
        (CONTACTS, [("12:30", "a", "b")], {"hold": 1}, 'line 2: time "12:30": expected a finite number'),
        (CONTACTS, [(0, "a", "b"), (1, "a")], {"hold": 1}, "line 3: \"1,a\": expected 3 values as in the header"),
        (CONTACTS, [], {"hold": 1}, "expected rows below the header"),
        (CONTACTS, [(0, "a", "b")], {}, "switching.hold: missing: expected with contacts"),
        (CONTACTS, [(0, "a", "b")], {"hold": 1, "radius": 2}, "switching.radius: 2.0: expected with positions"),
        (CONTACTS + ",weight", [(0, "a", "b", -1)], {"hold": 1}, "weight -1: expected a number > 0"),
        ("start,end,source,target", [(0, 2, "a", "b"), (1, 3, "a", "b")], {}, "line 3: expected no start 1 before"),
        ("start,end,source,target", [(1, 1, "a", "b")], {}, "line 2: expected the end of an interval after its start"),
        ("start,end,source,target", [(0, 1, "a", "b")], {"hold": 1}, "switching.hold: 1.0: expected none"),
        ("time,agent,x,y", [(0, "a", 0, 0)], {}, "switching.radius: missing"),
        ("time,agent,x,y", [(0, "a", 0, "inf")], {"radius": 1}, 'line 2: y "inf": expected a finite number'),
        ("when,who", [(0, "a")], {}, "expected the columns start,end,source,target or time,source,target or"),
        ("time,graph", [(0, "line")], {}, "graphs: missing: expected the graphs that the trace names"),
        ("time,graph", [(0, "line"), (0, "ring")], {"graphs": {"line": {"path": NAMES}}}, "line 3: a time twice"),
        ("time,graph", [(0, "ring")], {"graphs": {"line": {"path": NAMES}}}, '"ring": expected one of the graphs line'),
        (CONTACTS, [(0, "a", "b")], {"hold": 1, "graphs": {"line": {"path": NAMES}}}, "graphs: line: expected none"),
        (CONTACTS, [(0, "a", "b")], {"hold": 1}, "cannot be reached from"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "end": 9}, "switching.end: 9.0: expected without this trace"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "scale": 2}, "switching.scale: given: expected without"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "initial": "g1"}, "switching.initial: given: expected without"),
        ("time,graph", [(0, "x")], {"weight": 2, "graphs": {"x": {"path": NAMES}}}, "switching.weight: 2.0: expected"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "run": {"duration": 9}}, "9.0: expected at most 1"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "radios": 2}, "switching.radios: unknown key"),
        (CONTACTS, [(0, *p) for p in RING], {"hold": 1, "run": {"start": "stationary"}}, "needs a Markov chain"),
        (CONTACTS, [(EPOCH + k, *RING[0]) for k in (0, 10**9)], {"hold": 1}, "1e+09 after the first: expected times"),
        ("start,end,source,target", [(0, 10**11, *p) for p in RING], {}, "run.dt: 0.1: expected at most 1e+08 steps"),
        (",".join(f"c{k}" for k in range(10**5)), [(0, "a", "b")], {"hold": 1}, 'line 1: "c0,c1,c2,'),
    ],
)  # fmt: skip
def test_mistakes(tmp_path: Path, header: str, rows: list[Any], keys: dict[str, Any], wanted: str) -> None:
    with pytest.raises(ExperimentError) as caught:
        recorded(tmp_path, header, rows, **keys)
    assert wanted in str(caught.value)
    assert len(caught.value.problems) == 1


def test_more_links_or_agents_than_there_is_room_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Links of different graphs, together; equal ones count once."""
    monkeypatch.setattr(traces, "MOST_LINKS", 10)
    rows = [(time, *pair) for time in range(4) for pair in (RING if time % 2 else RING[:-1])]
    recorded(tmp_path, CONTACTS, rows, hold=1)
    with pytest.raises(ExperimentError, match="12 links in 3 graphs: expected at most 10 in all graphs together"):
        recorded(tmp_path, CONTACTS, [*rows, (4, *RING[0]), (4, *RING[1]), (4, *RING[2])], hold=1)
    crowd = [(0, f"r{k}", 0.0, 0.0) for k in range(6)]
    with pytest.raises(ExperimentError, match="15 links in 1 graph: expected at most 10 in all graphs together"):
        recorded(tmp_path, "time,agent,x,y", crowd, radius=1)
    monkeypatch.setattr(traces, "MOST_ROWS", 16)
    with pytest.raises(ExperimentError, match=r": 19 lines: expected at most 16: split it, or give intervals"):
        recorded(tmp_path, CONTACTS, rows, hold=1)
    monkeypatch.setattr(traces, "MOST_ROWS", 20)
    monkeypatch.setattr(traces, "MOST_AGENTS", 4)
    with pytest.raises(ExperimentError, match="more than 4 agents: expected fewer"):
        recorded(tmp_path, CONTACTS, rows, hold=1)


def test_a_unit_that_may_not_be_meant(tmp_path: Path) -> None:
    rows = [(EPOCH // 10**6, *pair) for pair in RING]
    (note,) = recorded(tmp_path, CONTACTS, rows, hold=1).notes
    assert note.endswith("time 0 of the run is 1.764e+12 in the file, which looks like milliseconds since 1970")
