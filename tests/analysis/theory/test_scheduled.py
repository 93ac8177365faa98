"""Predictions given the graphs, against a recursion with matrices that is written here; outages against networkx."""

from itertools import groupby
from typing import Any

import networkx as nx
import numpy as np
import pytest
from click.testing import CliRunner

from experiments import line_ring
from msg_analysis.cli.main import main
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment import limits
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import phases
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.scheduled import path_moments, without_stacks

DT = 0.1
AIR = {"loss": {"default": 0.3, "arcs": [[1, 2, 0.6]]}, "link": 0.5, "broadcast": 0.7}
LEADER = {"problem": "tracking", "leaders": {"agents": [2, 3], "gain": 1.5, "reference": 3.0}}
HELD = {"problem": "tracking", "leaders": {"agents": [2, 3], "gain": "inf", "reference": 3.0}}
CORRELATED = np.random.default_rng(1).normal(size=(6, 6)).tolist()
LAWS: dict[str, dict[str, Any]] = {
    "consensus": {},
    "undirected": {"symmetric": True},
    "sparse": {"agents": 25},
    "correlated": {"noise": {"process": CORRELATED}},
    "noise of each graph": {"noise": {"process": {f"g{g}": g + 0.5 for g in range(5)}}},
    "on the air": {"noise": AIR},
    "sparse, on the air": {"agents": 25, "noise": AIR},
    "tracking": LEADER,
    "grounded, on the air": {**HELD, "noise": AIR},
    "real time": {"run": {"pace": "realtime"}},
    "sparse, real time": {"agents": 25, "run": {"pace": "realtime"}},
    "correlated, real time": {"noise": {"process": CORRELATED}, "run": {"pace": "realtime"}},
    "grounded, real time": {**HELD, "run": {"pace": "realtime"}},
}


def given(agents: int = 6, symmetric: bool = False, **keys: Any) -> Experiment:
    """Four random graphs and a ring of that many agents, in turns."""
    rng = np.random.default_rng(agents)
    graphs = {"g0": {"arcs": [[2, 1], [1, 2], *([i, i + 1] for i in range(2, agents)), [agents, 1]]}}
    for g in range(1, 5):
        weights = np.triu(np.where(rng.random((agents, agents)) < 1.5 / agents, rng.uniform(0.5, 1.5), 0.0), 1)
        other = weights if symmetric else np.where(rng.random((agents, agents)) < 0.5, weights, 0.0)
        graphs[f"g{g}"] = {"adjacency": (weights + other.T).tolist()}
    times = 0.1 * np.append(0, np.cumsum(rng.integers(1, 5, 20)))
    schedule = [[float(t), f"g{rng.integers(5) if k else 0}"] for k, t in enumerate(times)]
    run = {"dt": DT, "duration": 6.0, "start": rng.normal(size=agents).tolist(), **keys.pop("run", {})}
    return Experiment.parse({"name": "net", "graphs": graphs, "switching": {"schedule": schedule}, "run": run, **keys})


def law_of(law: Experiment, mode: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """W in the mean over losses, covariance of the noise, and variance of every link, as docs/theory.md has them."""
    m, noise, gains = law.agents, law.noise, law.leader_gains
    heard = DT * law.graph_list[mode].adjacency
    held = np.isinf(gains)
    heard[held] = 0.0
    kept = (1.0 - law.loss) * heard
    weights = np.diag(1.0 - kept.sum(axis=1) - DT * np.where(held, 0.0, gains)) + kept
    gain = np.sqrt(DT) * law.noise_gain[mode]
    weights[held], gain[held] = 0.0, 0.0
    if law.run.pace == "realtime":  # one row after the other
        first, second = np.eye(m), np.zeros((m, m))
        for i in np.argsort(phases(law)).tolist():
            first[i], second[i] = weights[i] @ first, weights[i] @ second + gain[i]
        weights, gain = first, second
    published = noise.broadcast**2 * (kept @ kept.T + np.diag((law.loss * kept * heard).sum(axis=1)))
    air = published + noise.link**2 * np.diag((kept * heard).sum(axis=1))
    return weights, gain @ gain.T + air, law.loss * kept * heard


def by_recursion(law: Experiment, modes: IntArray) -> FloatArray:
    """(N, m, m) second moments of the deviations of x(1), ..., x(N)."""
    m = law.agents
    centre = np.eye(m) - 1.0 / m if law.problem == "consensus" else np.eye(m)
    laws = [law_of(law, mode) for mode in range(len(law.graph_list))]
    place = np.array(law.run.start) - law.reference
    moments, found = centre @ np.outer(place, place) @ centre, []
    for mode in modes.tolist():
        weights, noise, variance = laws[mode]
        own = np.diag(moments)
        lost = (variance * (own[:, None] + own - 2.0 * moments)).sum(axis=1)
        moments = centre @ (weights @ moments @ weights.T + noise + np.diag(lost)) @ centre
        found.append(moments)
    return np.array(found)


def graphs_of(law: Experiment) -> IntArray:
    """The graph of every step."""
    assert law.schedule is not None
    return law.schedule.sampled(law.steps, DT)


@pytest.mark.parametrize("name", LAWS)
def test_moments_without_stacks(name: str) -> None:
    """Against the recursion, and against the reduced system that compares runs."""
    law = given(**LAWS[name])
    assert without_stacks(law)
    found, expected = predict(law, start=1.0), by_recursion(law, graphs_of(law))
    assert found.path is not None
    np.testing.assert_allclose(found.path.system_errors, np.trace(expected, axis1=1, axis2=2), rtol=1e-11)
    mean = expected[10:].mean(axis=0)
    np.testing.assert_allclose(found.emulated.covariance, mean, rtol=1e-11, atol=1e-12 * mean.max())
    assert "step" not in vars(found.matrices)  # none were made
    place = np.array(law.run.start)[:, None]
    reduced, by_mode = path_moments(found.system, place, graphs_of(law), 10)
    np.testing.assert_allclose(reduced.covariance, mean, rtol=1e-11, atol=1e-12 * mean.max())
    np.testing.assert_allclose(found.steady, by_mode)


@pytest.mark.parametrize("more", [{}, {"noise": {"delay": 1}}, LEADER])
def test_what_outages_cost(more: dict[str, Any]) -> None:
    """The longest stretches by networkx; errors by the recursion without their steps."""
    law = given(**more)
    modes = graphs_of(law)
    parts = [nx.number_connected_components(nx.from_numpy_array(g.adjacency + g.adjacency.T)) for g in law.graph_list]
    stretches = [list(group) for apart, group in groupby(range(law.steps), lambda k: parts[modes[k]] > 1) if apart]
    longest = sorted(stretches, key=len, reverse=True)[:3]
    found = predict(law, start=2.0).to_json(3)["outages"]
    assert found["count"] == len(stretches) > 3
    assert [each["parts"] for each in found["longest"]] == [max(parts[modes[k]] for k in ks) for ks in longest]
    assert np.allclose([each["start"] for each in found["longest"]], [DT * ks[0] for ks in longest])
    assert np.allclose([each["end"] for each in found["longest"]], [DT * (ks[-1] + 1) for ks in longest])

    def error(gone: list[int]) -> float:
        left = [k for k in range(law.steps) if k not in gone]
        at = np.array(left) >= 20
        if not law.noise.delay:
            return float(np.trace(by_recursion(law, modes[left])[at].mean(axis=0)))
        shorter = [[DT * k, f"g{mode}"] for k, mode in enumerate(modes[left].tolist())]
        document = law.to_document() | {"switching": {"schedule": shorter}}
        document["run"] |= {"duration": DT * len(left)}
        return predict(Experiment.parse(document), start=DT * (~at).sum()).emulated.system_error

    assert found["error_without"] == pytest.approx(error([k for ks in longest for k in ks]), rel=1e-9)
    adds = [error([]) - error(ks) for ks in longest]
    assert [each["adds"] for each in found["longest"]] == pytest.approx(adds, rel=1e-7)


def test_of_what_there_are_no_outages() -> None:
    """A chain; a schedule that never ends to connect all; and one that never does, of which no step is left."""
    chain = {"name": "net", "graphs": {"line": {"path": [1, 2, 3]}, "arc": {"arcs": [[1, 2]]}}}
    rates = {"rates": {"line": {"arc": 1.0}, "arc": {"line": 1.0}}}
    with pytest.raises(NotAvailableError, match="outages: expected a given sequence of graphs"):
        predict(Experiment.parse(chain | {"switching": rates})).outages()
    whole = Experiment.parse(chain | {"switching": {"schedule": [[0, "line"]]}})
    assert predict(whole).outages().to_json() == {
        "count": 0,
        "error_without": predict(whole).emulated.system_error,
        "longest": [],
    }
    for noise in ({}, {"delay": 1}):
        never = Experiment.parse(chain | {"switching": {"schedule": [[0, "arc"]]}, "noise": noise})
        assert predict(never).to_json(1)["outages"] == {
            "count": 1,
            "error_without": None,
            "longest": [{"start": 0.0, "end": 100.0, "parts": 2, "adds": None}],
        }


def test_more_graphs_than_matrices_fit_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are predicted and described; what needs the matrices says so."""
    law = given(agents=25, run={"duration": 6.0})
    states, matrices = limits.memory_needed(25, 5, law.steps, 1)
    monkeypatch.setattr(limits, "available_memory", lambda: states + matrices - 1)
    law = given(agents=25)
    assert predict(law).to_json()["emulated"]["system_error"] > 0.0
    words = r"graphs: 5 graphs of 25 agents need 200 kB: expected at most .*: lower the number of agents or graphs"
    with pytest.raises(NotAvailableError, match=words):
        _ = predict(law).system
    with pytest.raises(NotAvailableError, match=words):
        law.simulate()


def test_options_of_outages(tmp_path: Any) -> None:
    """A table, unless none is asked for."""
    file = tmp_path / "net.yaml"
    schedule = "[[0, line], [2, arc], [2.5, line], [5, arc], [7, line]]"
    graphs = "graphs: {line: {path: [1, 2, 3]}, arc: {arcs: [[1, 2]]}}"
    file.write_text(f"name: net\n{graphs}\nswitching: {{schedule: {schedule}}}\nrun: {{duration: 10}}\n")
    found = CliRunner().invoke(main, ["predict", str(file), "--outages", "1"])
    lines = [" ".join(line.split()) for line in found.stdout.splitlines()]
    assert "from to parts adds to the mean error" in lines
    assert any(line.startswith("5 7 2 ") for line in lines)
    assert any(line.startswith("2 outages; mean system error without this: ") for line in lines)
    assert "outages" not in CliRunner().invoke(main, ["predict", str(file), "--outages", "0"]).stdout
    wrong = CliRunner().invoke(main, ["predict", "line_ring", "--outages", "1"])
    assert (wrong.exit_code, wrong.stdout) == (2, "")
    assert wrong.stderr.startswith("error: outages: expected a given sequence of graphs")


def test_bursts_over_more_graphs_than_a_chain_may_have() -> None:
    """Three hundred names of two graphs in turn: the prediction of the two graphs is the oracle."""
    sides = [{"edges": [[1, 2], [2, 3]]}, {"edges": [[1, 3]]}]
    noise = {"loss": {"arcs": [[1, 2, 0.4]]}, "burst": 4.0}
    found = []
    for count in (2, 300):
        schedule = [[0.1 * k, f"g{k % count}"] for k in range(300)]
        graphs = {f"g{k}": sides[k % 2] for k in range(count)}
        law = line_ring(3, graphs=graphs, switching={"schedule": schedule, "end": 30.0}, noise=noise)
        found.append(predict(law).emulated.system_error)
    assert found[1] == pytest.approx(found[0], rel=1e-12)
