"""Links that switch by themselves: their path, the exact prediction of few of them, and verdicts link by link."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from p_values import assert_covered

from experiments import TRACKING, compare, logged
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment.experiment import Experiment, ExperimentError
from msg_analysis.experiment.limits import prediction_method
from msg_analysis.theory.sampling import sampled_prediction
from msg_analysis.twin.simulate import simulate

TEN = [[1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [1, 3], [2, 4], [1, 6], [2, 5], [3, 6]]
MESSAGES: dict[str, dict[str, Any]] = {
    "plain": {},
    "directed": {"graphs": {"mesh": {"arcs": [[i, j, 0.5] for i in range(1, 5) for j in range(1, 5) if i != j]}}},
    "air": {"noise": {"broadcast": 0.5, "link": 0.4, "loss": 0.2}},
    "held": {"noise": {"loss": 0.3, "on_loss": "hold"}},
    "late": {"noise": {"delay": 2, "link": 0.3}},
    "tracking": TRACKING,
    "discrete time": {"time": "discrete", "run": {"dt": 1.0, "duration": 600}},
    "real time": {"run": {"pace": "realtime"}},
    "real time, air": {"noise": {"link": 0.4, "loss": 0.2}, "run": {"pace": "realtime"}},
}


def linked(links: int = 9, up: Any = 0.5, down: Any = 0.5, **changes: Any) -> Experiment:
    run = {"dt": 0.05, "duration": 30, "replicas": 4} | changes.pop("run", {})
    return Experiment.parse(
        {
            "name": "net",
            "graphs": {"mesh": {"edges": TEN[:links]}},
            "switching": {"links": {"up": up, "down": down}},
            "run": run,
            **changes,
        }
    )


def test_path_of_a_run() -> None:
    """Each link changes with its own rates: 6 numbers beyond 4.5 standard errors with probability 4e-5."""
    up, down = {"default": 0.5, "edges": [[1, 2, 3.0]]}, {"default": 0.4, "edges": [[2, 3, 2.0]]}
    law = linked(3, up, down, run={"duration": 4000})
    run = simulate(law.with_run(duration=20))
    assert law.links is not None
    long = law.switching_law.sampled(law.steps, 0.05)  # type: ignore[union-attr]
    np.testing.assert_array_equal(run.modes, long[:400])  # a shorter run is its beginning
    assert len(law.graph_list) == 8
    for graph in law.graph_list:
        assert [[i, j] for i, j, _ in graph.edges] == [
            ends for ends, bit in zip(TEN, graph.name, strict=False) if bit == "1"
        ]
    there = np.array([[bit == "1" for bit in graph.name] for graph in law.graph_list])[long]
    for link, (rise, fall) in enumerate([(3.0, 0.4), (0.5, 2.0), (0.5, 0.4)]):
        left = -math.expm1(-(rise + fall) * 0.05) / (rise + fall)
        for state, rate in ((False, rise), (True, fall)):
            now = there[:-1, link] == state
            share, chance = (there[1:, link] != state)[now].mean(), rate * left
            assert abs(share - chance) < 4.5 * math.sqrt(chance * (1 - chance) / now.sum())


def test_exact_predictions() -> None:
    """Nine links by a brute-force product chain that is not ours; one more is refused in words; two by hand."""
    assert linked().predict().emulated.system_error == pytest.approx(3.41958, abs=5e-6)
    with pytest.raises(NotAvailableError, match=r"switching\.links: .* 2\^10 graphs"):
        linked(10).predict()
    metropolis: dict[str, Any] = {"protocol": {"name": "metropolis", "laziness": 0.3}}
    for time, rates, protocol in (
        ("continuous", (0.6, 1.5, 0.2, 0.9), {}),
        ("continuous", (0.6, 1.5, 0.2, 0.9), metropolis),
        ("discrete", (0.4, 0.3, 0.2, 0.1), {}),
    ):
        rise, fall, up, down = rates
        graphs = {f"{i}{j}": {"edges": [*[[1, 2]] * i, *[[2, 3, 0.5]] * j]} for i in (0, 1) for j in (0, 1)}
        if time == "continuous":
            chain: dict[str, Any] = {
                "rates": {
                    "00": {"01": up, "10": rise},
                    "01": {"00": down, "11": rise},
                    "10": {"00": fall, "11": up},
                    "11": {"10": down, "01": fall},
                }
            }
        else:
            first, second = [[1 - rise, rise], [fall, 1 - fall]], [[1 - up, up], [down, 1 - down]]
            chain = {"transition": [[a * b for a in x for b in y] for x in first for y in second]}
        dt = {"run": {"dt": 1.0}} if time == "discrete" else {}
        rates_of = [{"edges": [[1, 2, a], [2, 3, b]]} for a, b in ((rise, up), (fall, down))]
        mesh = {"mesh": {"edges": [[1, 2], [2, 3, 0.5]]}}
        found = linked(2, *rates_of, graphs=mesh, time=time, **dt, **protocol)
        by_hand = linked(2, graphs=graphs, switching=chain, time=time, **dt, **protocol)
        np.testing.assert_allclose(
            found.predict().emulated.covariance, by_hand.predict().emulated.covariance, rtol=1e-10
        )
        np.testing.assert_allclose(
            found.transient([1, 5]).node_errors, by_hand.with_run(start="zero").transient([1, 5]).node_errors, rtol=1e-9
        )
        variances = [law.plan(0.05).precision.variance for law in (found, by_hand.with_run(start="zero"))]
        assert [variances[0].path, variances[0].replica] == pytest.approx([variances[1].path, variances[1].replica])


def test_how_errors_are_known() -> None:
    """Many links are sampled; losses in bursts only in the built-in law in continuous time."""
    assert [prediction_method(linked(links))[0] for links in (9, 10)] == ["exact", "sampled"]
    for changes in ({"time": "discrete", "run": {"dt": 1.0}}, {"protocol": {"name": "metropolis", "laziness": 0.3}}):
        assert prediction_method(linked(10, **changes, noise={"loss": 0.2}))[0] == "sampled"
        bursts = linked(10, **changes, noise={"loss": 0.2, "burst": 5})
        assert prediction_method(bursts)[0] == "measured"
        with pytest.raises(NotAvailableError, match=r"or no noise\.burst: no sampling here"):
            sampled_prediction(bursts)


@pytest.mark.parametrize("messages", MESSAGES)
def test_correct_runs(messages: str) -> None:
    law = linked(9 if messages == "plain" else 6, **MESSAGES[messages])
    found = [compare(simulate(law.with_run(seed=seed))) for seed in range(12)]
    assert_covered(found)
    assert all("links" in [test.name for test in one.tests] for one in found)


def test_a_wrong_rate_and_a_link_that_is_not_there(tmp_path: Path) -> None:
    """Both are read from the log of a bag: its graphs are not those that the record would draw."""
    law = linked(5, run={"duration": 1500, "replicas": 1})
    slow = linked(5, up={"default": 0.5, "edges": [[3, 4, 0.25]]}, run={"duration": 1500, "replicas": 1})
    write_trajectory(logged(simulate(slow), law), tmp_path / "slow")
    run = read_bag(tmp_path / "slow")
    assert run.completeness.complete
    found = compare(run)
    assert (found.verdict, found.causes[0].kind, found.causes[0].link) == ("disagrees", "link", (3, 4))
    assert found.causes[0].words.startswith("link 3-4 comes up ")
    low, high = found.causes[0].interval or (0.0, 0.0)
    assert low < 0.5 < high
    more = compare(logged(simulate(linked(10)), linked()))
    assert (more.verdict, more.causes[0].kind) == ("disagrees", "schedule")
    assert "agent 3 was linked to agent 6 in step" in more.causes[0].words


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"switching": {"links": {"up": 0, "down": 1}}}, "switching.links.up: 0 for link 1-2: expected more than 0"),
        ({"switching": {"links": {"up": -1, "down": 1}}}, "switching.links.up: -1: expected a rate >= 0"),
        ({"switching": {"links": {"up": 1}}}, "switching.links.down: missing"),
        (
            {"switching": {"links": {"up": {"default": 1, "edges": [[1, 5, 2.0]]}, "down": 1}}},
            "switching.links.up.edges: [1, 5]: expected the agents of an undirected link of the graph",
        ),
        (
            {"switching": {"links": {"up": {"default": 1, "arcs": [[1, 2, 2.0]]}, "down": 1}}},
            "switching.links.up.arcs: [1, 2]: expected the agents of a link in one direction",
        ),
        (
            {"switching": {"links": {"up": {"default": 1, "edges": [[1, 2, 2.0], [2, 1, 1.0]]}, "down": 1}}},
            "switching.links.up.edges: [2, 1]: expected every link once",
        ),
        (
            {"switching": {"links": {"up": 1, "down": 1}, "initial": "mesh"}},
            "switching.initial: given: expected without links that switch by themselves",
        ),
        ({"switching": {"links": {"up": 1, "down": 1}, "end": 3.0}}, "switching.end: 3.0: expected with a schedule"),
        ({"graphs": {"a": {"path": [1, 2]}, "b": {"path": [2, 1]}}}, "graphs: a, b: expected one graph"),
        ({"run": {"start": "stationary"}}, "run.start: stationary: expected 'zero' or values"),
        (
            {"time": "discrete", "run": {"dt": 1.0}, "switching": {"links": {"up": 0.5, "down": 1.5}}},
            "switching.links: 0.5 and 1.5: expected probabilities up to 1",
        ),
    ],
)
def test_mistakes(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ExperimentError) as error:
        linked(**changes)
    assert message in str(error.value)


def test_names_of_agents() -> None:
    names = ["a", "b", "c"]
    law = linked(
        up={"default": 1.0, "edges": [["a", "b", 2.0]]}, graphs={"mesh": {"path": ["a", "b", "c"]}}, names=names
    )
    assert law.links is not None
    assert [law.links.words(link, names) for link in range(2)] == ["a-b", "b-c"]
    assert law.links.up.tolist() == [2.0, 1.0]
    assert Experiment.parse(law.to_document()) == law
