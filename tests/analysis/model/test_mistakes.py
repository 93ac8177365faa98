"""Every mistake in an experiment file is one line: the key, the value, what was expected and what to do."""

import copy
import math
from typing import Any

import pytest

from msg_analysis.experiment import limits
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.problems import ExperimentError

GOOD: dict[str, Any] = {
    "name": "good",
    "problem": "consensus",
    "time": "continuous",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
    "noise": {"process": 1.0},
    "run": {"dt": 0.05, "duration": 400},
}
DISCRETE = {"time": "discrete", "run.dt": ...}
TRACKING = {"problem": "tracking", "leaders": {"agents": [3], "gain": 1.0}}
STABLE_DT = 2 / (2 - 2 * math.cos(4 * math.pi / 5))  # 2 / lambda_max of the ring of five


def changed(changes: dict[str, Any]) -> dict[str, Any]:
    """The good document with values at dotted keys replaced, or removed (...)."""
    document = copy.deepcopy(GOOD)
    for key, value in copy.deepcopy(changes).items():  # cases share parts of them
        *sections, last = key.split(".")
        place = document
        for section in sections:
            place = place.setdefault(section, {})
        if value is ...:
            place.pop(last)
        else:
            place[last] = value
    return document


def problems_of(changes: dict[str, Any]) -> list[str]:
    with pytest.raises(ExperimentError) as caught:
        Experiment.parse(changed(changes))
    return caught.value.problems


CASES: list[tuple[dict[str, Any], list[str]]] = [
    # keys and types
    ({"nmae": 1}, ["nmae: unknown key: expected one of name, problem, ", "did you mean 'name'?"]),
    ({"run.foo": 1}, ["run.foo: unknown key: expected one of dt, duration, ", "remove it"]),
    ({"graphs.ring": {"pth": [1, 2]}}, ["graphs.ring.pth: unknown key", "did you mean 'path'?"]),
    ({"name": ...}, ["name: missing: expected a name", "for example name:"]),
    ({"graphs": ...}, ["graphs: missing: expected named graphs"]),
    ({"name": "Line ring"}, ['name: "Line ring": expected a name of the form [a-z][a-z0-9_]*']),
    ({"name": "good\n"}, ['name: "good\\n": expected a name']),
    ({"problem": "consenus"}, ["problem: \"consenus\": expected 'consensus' or", "did you mean 'consensus'?"]),
    ({"time": 3}, ["time: 3: expected 'continuous' or 'discrete'"]),
    ({"run": None}, ["run: null: expected keys with values: for example run:"]),
    ({"run.dt": True}, ["run.dt: true: expected a number: for example dt: 0.05"]),
    ({"run.dt": "0.1"}, ['run.dt: "0.1": expected a number']),
    ({"run.dt": math.nan}, ["run.dt: .nan: expected a finite number"]),
    ({"run.duration": math.inf}, ["run.duration: .inf: expected a finite number"]),
    ({"run.dt": 0}, ["run.dt: 0: expected a number > 0"]),
    ({"run.replicas": True}, ["run.replicas: true: expected a whole number"]),
    ({"run.replicas": 2.5}, ["run.replicas: 2.5: expected a whole number"]),
    ({"run.replicas": 0}, ["run.replicas: 0: expected a number >= 1"]),
    ({"run.seed": -1}, ["run.seed: -1: expected a number >= 0"]),
    ({"run.pace": "realtme"}, ["run.pace:", "did you mean 'realtime'?"]),
    ({"run.delivery": "besteffort"}, ["run.delivery:", "did you mean 'best_effort'?"]),
    (
        {"run.delivery": "best_effort"},
        ["run.delivery: best_effort: in lockstep expected reliable", "run.pace: realtime"],
    ),
    ({"run.speed": 0}, ["run.speed: 0: expected a number > 0"]),
    ({"run.processes": 0}, ["run.processes: 0: expected 'auto', 'one_per_agent' or a whole number >= 1"]),
    ({"graphs": {1: {"path": [1, 2]}}, "switching": ...}, ["graphs: key 1: expected a text"]),
    # what other programs call it, or in another section
    (
        {"graphs.ring": {"edges": [[1, 2]], "directed": True}},
        ["graphs.ring.directed: unknown key", "for a directed graph give `arcs: [[1, 2]]`: agent 2 listens to agent 1"],
    ),
    (
        {"graphs.ring": {"edges": [[1, 2]], "directed": False}},
        ["graphs.ring.directed: unknown key", "remove it: `edges`"],
    ),
    (
        {"graphs.ring": {"edges": [[1, 2]], "weight": 0.5}},
        [
            "graphs.ring.weight: 0.5: expected with path, cycle, star, grid, complete only",
            "as the third entry of a link, for example `edges: [[1, 2, 0.5]]`",
        ],
    ),
    ({"graphs.ring": {"links": [[1, 2]]}}, ["graphs.ring.links: unknown key", "did you mean `edges`, or `arcs`"]),
    ({"graphs.ring": {"nodes": 3}}, ["graphs.ring.nodes: unknown key", "as `agents`, beside `graphs`"]),
    ({"seed": 3}, ["seed: unknown key", "did you mean `run.seed`?"]),
    ({"run.process": 3}, ["run.process: unknown key", "did you mean `noise.process`?"]),
    ({"run.noise": {}}, ["run.noise: unknown key", "did you mean `noise`, without `run`?"]),
    # graphs
    ({"graphs": {}}, ["graphs: missing: expected named graphs"]),
    ({"graphs.ring": {}}, ["graphs.ring: nothing: expected one of path, cycle, edges"]),
    ({"graphs.ring": {"path": [1, 2], "complete": True}}, ["graphs.ring: path and complete: expected one of"]),
    ({"graphs.ring": {"complete": False}}, ["graphs.ring.complete: false: expected true"]),
    ({"graphs.ring": {"path": [0, 1]}}, ["graphs.ring.path[1]: 0: expected a number >= 1"]),
    ({"graphs.ring": {"path": [1]}}, ["graphs.ring.path: [1]: expected at least 2 entries"]),
    ({"graphs.ring": {"path": [1, 1, 2]}}, ["graphs.ring.path: [1, 1]: agent 1 is linked with itself", "remove"]),
    ({"graphs.ring": {"edges": [[1, 2], [2, 1]]}}, ["graphs.ring.edges: [2, 1]: expected every edge", "once"]),
    ({"graphs.ring": {"arcs": [[1, 2], [1, 2]]}}, ["graphs.ring.arcs: [1, 2]: expected every arc once"]),
    ({"graphs.ring": {"arcs": [[3, 3]]}}, ["graphs.ring.arcs: [3, 3]: agent 3 is linked with itself"]),
    ({"graphs.ring": {"path": [1, 2, 1]}}, ["graphs.ring.path: [2, 1]: expected every edge"]),
    ({"graphs.ring": {"edges": [[1, 2, 0]]}}, ["graphs.ring.edges[1]: [1, 2, 0]: expected a weight > 0"]),
    ({"graphs.ring": {"edges": [[1, 2, True]]}}, ["graphs.ring.edges[1]: [1, 2, true]: expected a weight"]),
    ({"graphs.ring": {"arcs": [[1, 2, math.inf]]}}, ["graphs.ring.arcs[1]", "expected a weight > 0"]),
    ({"graphs.ring": {"edges": [[1, 2], [1, 2, 3, 4]]}}, ["graphs.ring.edges[2]: [1, 2, 3, 4]: expected [agent, "]),
    ({"graphs.ring": {"edges": [[1, True]]}}, ["graphs.ring.edges[1]: [1, true]: expected [agent, agent]"]),
    ({"graphs.ring": {"path": [1, 10**400]}}, ["graphs.ring.path[2]: 1000", "expected a number <= 4294967295"]),
    ({"graphs.ring": {"edges": [[1, 10**400]]}}, ["graphs.ring.edges[1]: [1, 1000", "expected [agent, agent]"]),
    ({"graphs.ring": {"edges": [[1, 2, 1e308]]}}, ["graphs.ring.edges[1]: [1, 2, 1e+308]: expected a weight"]),
    ({"graphs.ring": {"grid": [3, 0]}}, ["graphs.ring.grid: [3, 0]: expected [rows, columns]"]),
    ({"graphs.ring": {"graphml": "nope"}}, ["graphs.ring.graphml: nope: no such file", "relative"]),
    ({"agents": 4}, ["graphs.line.path: agent 5: expected agents 1 to 4"]),
    ({"agents": 4}, ["graphs.ring.cycle: agent 5: expected agents 1 to 4"]),
    ({"agents": 1}, ["agents: 1: expected a number >= 2"]),
    ({"agents": 5, "graphs.ring": {"grid": [2, 3]}}, ["graphs.ring.grid: agent 6: expected agents 1 to 5"]),
    ({"graphs": {"all": {"complete": True}}, "switching": ...}, ["agents: missing: expected the number of agents"]),
    ({"graphs.stationary": {"complete": True}}, ["graphs: 'stationary': expected another name"]),
    # connection
    ({"agents": 7}, ["graphs: agents 6, 7 cannot be reached from agents 1, 2, 3, 4, 5 in the union"]),
    (
        {"graphs": {"line": {"path": [1, 2]}, "ring": {"path": [3, 4, 5]}}},
        ["graphs: agents 1, 2 cannot be reached from agents 3, 4, 5 in the union", "add an edge"],
    ),
    (
        {"graphs": {"line": {"arcs": [[1, 2]]}, "ring": {"arcs": [[3, 2]]}}},
        ["graphs: agent 3 cannot be reached from agent 1 in the union"],
    ),
    (
        TRACKING | {"graphs": {"line": {"arcs": [[1, 2]]}, "ring": {"arcs": [[3, 2]]}}},
        ["graphs: agent 1 cannot be reached from a leader in the union"],
    ),
    # switching
    ({"switching": ...}, ["switching: missing: expected generator or rates, since there are 2 graphs"]),
    ({"switching.generator": [[-1, 0.9], [1, -1]]}, ["switching.generator[1]: row 1 (line) sums to -0.1: expected 0"]),
    ({"switching.generator": [[-1e-10, 2e-10], [1, -1]]}, ["switching.generator[1]: row 1 (line) sums to 1e-10"]),
    ({"switching.generator": [[1, -1], [1, -1]]}, ["switching.generator[1][2]: -1.0: expected a rate >= 0"]),
    ({"switching.generator": [[-1e308, 1e308], [1, -1]]}, ["switching.generator[1][1]: -1e+308: expected a number"]),
    ({"switching.generator": [[-1, 1]]}, ["switching.generator: 1 rows of 2 entries: expected 2 x 2"]),
    ({"switching.generator": [[-1, 1], [1]]}, ["switching.generator: 2 rows of 1 or 2 entries: expected 2 x 2"]),
    ({"switching.generator": [[-1, 1], [1, True]]}, ["switching.generator[2][2]: true: expected a number"]),
    (
        {"switching.generator": [[0, 0], [1, -1]]},
        ["switching.generator: ring cannot be reached from line: expected an ergodic chain"],
    ),
    (
        {"switching": {"rates": {"lin": {"ring": 1}}}},
        ["switching.rates.lin: unknown graph: expected one of the graphs"],
    ),
    ({"switching": {"rates": {"line": {"rin": 1}}}}, ["switching.rates.line.rin: unknown graph"]),
    ({"switching": {"rates": {"line": {"line": 1}}}}, ["switching.rates.line.line: 1.0: expected rates to other"]),
    ({"switching": {"rates": {"line": {"ring": -1}}}}, ["switching.rates.line.ring: -1: expected a number >= 0"]),
    ({"switching": {"rates": {"line": {"ring": 1}}}}, ["switching.rates: line cannot be reached from ring"]),
    ({"switching.scale": 2}, ["switching.scale: 2.0: expected with rates only"]),
    ({"switching.rates": {}}, ["switching: generator and rates: expected one of them"]),
    ({"switching": {"transition": [[0.5, 0.5]] * 2}}, ["switching.transition: given in continuous time: expected gen"]),
    (
        {"switching.initial": "rng"},
        ["switching.initial: \"rng\": expected 'stationary' or one of the graphs line, ring"],
    ),
    (DISCRETE, ["switching.generator: given in discrete time: expected transition"]),
    (
        DISCRETE | {"switching": {"transition": [[0.5, 0.4], [0.5, 0.5]]}},
        ["switching.transition[1]: row 1 (line) sums to 0.9: expected 1"],
    ),
    (
        DISCRETE | {"switching": {"transition": [[1.5, -0.5], [0.5, 0.5]]}},
        ["switching.transition[1][2]: -0.5: expected a probability between 0 and 1"],
    ),
    (
        DISCRETE | {"switching": {"transition": [[0, 1], [1, 0]]}},
        ["switching.transition: the chain has period 2: expected an ergodic chain"],
    ),
    # noise
    ({"noise.process": -1}, ["noise.process: -1: expected a standard deviation >= 0"]),
    ({"noise.process": [1, 1, 1, 1, -1]}, ["noise.process: [1, 1, 1, 1, -1]: expected standard deviations >= 0"]),
    ({"noise.process": [1, 2]}, ["noise.process: 2 entries: expected a number, 5 numbers or a 5 x 5 matrix F"]),
    ({"noise.process": [[1] * 5] * 4}, ["noise.process: 4 x 5: expected a number, 5 numbers or a 5 x 5 matrix F"]),
    ({"noise.process": [[1, 2], [1]]}, ["noise.process: rows of different lengths: expected a number"]),
    ({"noise.process": [[1, "a"]]}, ["noise.process:", "expected a finite number, one per agent, or a square"]),
    ({"noise.process": True}, ["noise.process: true: expected a finite number"]),
    ({"noise.process": 10**400}, ["noise.process: 1000", "expected a finite number"]),
    ({"noise.broadcast": -0.1}, ["noise.broadcast: -0.1: expected a number >= 0"]),
    ({"noise.link": math.nan}, ["noise.link: .nan: expected a finite number"]),
    ({"noise.loss": 1}, ["noise.loss: 1: expected a number < 1"]),
    ({"noise.loss": -0.1}, ["noise.loss: -0.1: expected a number >= 0"]),
    ({"noise.delay": -1}, ["noise.delay: -1: expected a number >= 0: for example delay: 0"]),
    ({"noise.delay": 0.5}, ["noise.delay: 0.5: expected a whole number"]),
    ({"noise.delay": True}, ["noise.delay: true: expected a whole number"]),
    ({"noise.delay": 2**31}, ["noise.delay: 2147483648 steps with 2 graphs of 5 agents need", "lower the delay"]),
    ({"noise.process": {"line": 1}}, ["noise.process.ring: missing: expected the noise of every graph: for example"]),
    (
        {"noise.process": {"line": 1, "ring": 1, "rong": 1}},
        ["noise.process.rong: unknown graph: expected one of the graphs line, ring: correct the name"],
    ),
    (
        {"noise.process": {"line": 1, "ring": [1, 2]}},
        ["noise.process.ring: 2 entries: expected a number, 5 numbers or a 5 x 5 matrix F: there are 5 agents"],
    ),
    (
        {"noise.process": {"line": -1, "ring": "x"}},
        [
            'noise.process: {"line": -1, "ring": "x"}: expected for graph line a standard deviation >= 0',
            "and for graph ring a finite number, one per agent, or a square matrix F",
        ],
    ),
    ({"noise.process": {"line": {"ring": 1}, "ring": 1}}, ["noise.process:", "expected for graph line a finite num"]),
    # leaders
    ({"problem": "tracking"}, ["leaders: missing: expected leaders, since problem is tracking"]),
    ({"leaders": {"agents": [1]}}, ["leaders: given with problem: consensus: expected none: set problem: tracking"]),
    (TRACKING | {"leaders.agents": []}, ["leaders.agents: []: expected at least 1"]),
    (TRACKING | {"leaders.agents": [1, 1]}, ["leaders.agents: agent 1 twice: expected every leader once"]),
    (TRACKING | {"leaders.agents": [6]}, ["leaders.agents: agent 6: expected agents 1 to 5"]),
    (TRACKING | {"leaders.gain": 0}, ["leaders.gain: 0: expected a number > 0, or inf"]),
    (TRACKING | {"leaders.gain": math.nan}, ["leaders.gain: .nan: expected a number > 0"]),
    (TRACKING | {"leaders.reference": math.inf}, ["leaders.reference: .inf: expected a finite number"]),
    (
        TRACKING | {"leaders": {"agents": [1, 2, 3, 4, 5], "gain": "inf"}},
        ["leaders.agents: all agents, with gain inf: expected at least one agent that follows"],
    ),
    # the run
    ({"run.dt": 0.625}, [f"run.dt: 0.625: expected less than {STABLE_DT:.6g}, the stability limit of graph ring"]),
    (DISCRETE | {"run.dt": 0.5}, ["run.dt: 0.5: expected 1 in discrete time"]),
    ({"run.dt": 0.03}, ["run.duration: 400.0: expected a whole number of steps of 0.03: for example 399.99"]),
    ({"run.duration": 1e-9}, ["run.duration: 1e-09: expected a whole number of steps of 0.05: for example 0.05"]),
    ({"run.dt": 1e-320}, ["run.dt: 1e-320: expected at most 1e+15 steps"]),
    ({"run.replicas": 10**400}, ["run.replicas: 1000", "expected a number <= 4294967295"]),
    ({"run.duration": 3e9}, ["run.duration: 3000000000.0: expected at most 2147483647"]),
    ({"run.external": [6]}, ["run.external: agent 6: expected agents 1 to 5"]),
    ({"run.external": [2, 3, 2]}, ["run.external: agent 2 twice: expected every agent once"]),
    ({"run.external": ["north"]}, ['run.external: "north": expected a number, since no agent is named']),
    ({"run.external": []}, ["run.external: []: expected at least 1 entries"]),
    ({"run.external": [1.5]}, ["run.external[1]: 1.5: expected"]),
    ({"run.external": [1], "protocol": {"name": "metropolis"}}, ["run.external: [1]: expected none with a protocol"]),
    ({"run.publish": ["tf"]}, ['run.publish[1]: "tf": expected']),
    ({"run.publish": ["pose", "pose"]}, ['run.publish: ["pose", "pose"]: expected each once']),
    ({"run.frame": "odom"}, ['run.frame: "odom": expected with run.publish only']),
    ({"run.start": [1, 2]}, ["run.start: 2 values: expected one value for each of the 5 agents"]),
    ({"run.start": "stationry"}, ["run.start: \"stationry\": expected 'stationary', 'zero' or a list"]),
    ({"run.start": [1, 2, 3, 4, math.nan]}, ["run.start: [1, 2, 3, 4, .nan]: expected"]),
    # memory
    ({"run.replicas": 10**9}, ["run: 8000 steps of 5 agents with 1000000000 replicas need 320 TB: expected at most"]),
    ({"graphs.ring": {"grid": [10**5, 10**5]}}, ["graphs: 2 graphs of 10000000000 agents need", "lower the number"]),
]


@pytest.mark.parametrize(("changes", "fragments"), CASES, ids=[case[1][0][:60] for case in CASES])
def test_mistake(changes: dict[str, Any], fragments: list[str]) -> None:
    problems = problems_of(changes)
    line = next((line for line in problems if line.startswith(fragments[0])), None)
    assert line, problems
    assert all(fragment in line for fragment in fragments), line
    assert "\n" not in line
    assert line.count(": ") >= 2, "key: value: what was expected: what to do"


def test_a_key_that_is_no_text() -> None:
    """The only mistake: the document itself is good."""
    with pytest.raises(ExperimentError, match="experiment: key 1: expected a text") as caught:
        Experiment.parse({**GOOD, 1: 2})
    assert len(caught.value.problems) == 1


def test_all_mistakes_come_together() -> None:
    problems = problems_of(
        {"foo": 1, "noise.process": -1, "run.dt": 0, "leaders": {"agents": [1]}, "agents": 4, "switching": ...}
    )
    keys = sorted(line.split(":")[0] for line in problems)
    assert keys == ["foo", "graphs.line.path", "graphs.ring.cycle", "leaders", "noise.process", "run.dt", "switching"]


def test_text_names_the_source_and_lists_the_problems() -> None:
    with pytest.raises(ExperimentError) as caught:
        Experiment.parse(changed({"foo": 1, "bar": 2}), source="file.yaml")
    lines = str(caught.value).splitlines()
    assert lines[0] == "file.yaml: 2 problems"
    assert [line.split(":")[0] for line in lines[1:]] == ["  foo", "  bar"]
    with pytest.raises(ExperimentError, match=r"^file\.yaml: foo: unknown key"):
        Experiment.parse(changed({"foo": 1}), source="file.yaml")


def test_memory_is_compared_with_what_is_available(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = sum(limits.memory_needed(agents=5, modes=2, steps=8000, replicas=1))
    monkeypatch.setattr(limits, "available_memory", lambda: needed)
    Experiment.parse(GOOD)
    monkeypatch.setattr(limits, "available_memory", lambda: needed - 1)
    assert "need 320 kB: expected at most 323 kB, the memory available" in problems_of({})[0]


def test_available_memory_is_a_plausible_number_of_bytes() -> None:
    assert 2**20 < limits.available_memory() < 2**60
