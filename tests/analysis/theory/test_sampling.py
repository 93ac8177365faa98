"""Sampled errors: unbiased, with an interval that holds, the same for the same seed."""

import math

import numpy as np
import pytest

from experiments import CORRELATED, TRACKING, Experiment, directed, five, line_ring, pieces
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment import limits
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.report.documents import describe_experiment
from msg_analysis.theory import sampling
from msg_analysis.theory.sampling import SampledPrediction, sampled_prediction

HELD = {"process": 1.0, "loss": 0.4, "on_loss": "hold", "broadcast": 0.7, "link": 0.5}
BURSTS = {"loss": {"arcs": [[1, 2, 0.4], [2, 3, 0.3]]}, "burst": 5, "broadcast": 0.4, "link": 0.5}
REALTIME = {"dt": 0.2, "pace": "realtime"}
LAWS: dict[str, Experiment] = {
    "undirected": five(),
    "directed, weighted": directed(),
    "tracking": directed(**TRACKING),
    "grounded leader": five(**TRACKING | {"leaders": {"agents": [1], "gain": "inf", "reference": 2.0}}),
    "correlated noise": pieces(),
    "noise by graph": five(noise={"process": {"line": 0.0, "ring": [0.5, 1.0, 0.0, 1.0, 0.5]}}),
    "rare noise": line_ring(3, 0.05, noise={"process": {"line": 0.0, "ring": 1.0}}, run={"dt": 0.2}),
    "noise of messages alone": five(noise={"process": 0.0, "broadcast": 1.0}, run={"dt": 0.2}),
    "long delay": five(noise={"delay": 12}, run={"dt": 0.05}),
    "own value for lost ones": five(noise={"loss": 0.3}, run={"dt": 0.2}),
    "whole links": five(noise={"loss": 0.5, "whole_link": True}, run={"dt": 0.2}),
    "bursts": line_ring(3, 1.0, noise=BURSTS, run={"dt": 0.2}),
    "bursts, held": line_ring(3, 1.0, noise=BURSTS | {"on_loss": "hold"}, run={"dt": 0.2}),
    "held": five(noise=HELD, run={"dt": 0.2}),
    "delay": five(noise={"delay": 2, "loss": 0.2, "link": 0.5}, run={"dt": 0.1}),
    "delay, held": five(noise=HELD | {"delay": 2}, run={"dt": 0.1}),
    "real time": line_ring(3, 1.0, noise={"process": CORRELATED}, run=REALTIME),
    "real time, noise on the air": five(noise={"loss": 0.3, "broadcast": 0.7, "link": 0.5}, run=REALTIME),
    "real time, held": five(noise=HELD | {"delay": 1}, run=REALTIME | {"dt": 0.1}),
    "linear protocol": five(protocol={"name": "metropolis"}),
    "discrete time": line_ring(5, time="discrete", switching={"transition": [[0.9, 0.1], [0.2, 0.8]]}),
}


def z_of(sampled: SampledPrediction, exact: float) -> float:
    low, high = sampled.interval
    return (sampled.system_error - exact) / (high - low) * 2.0 * 1.96


@pytest.mark.parametrize("name", LAWS)
def test_the_mean_is_the_exact_prediction(name):
    """The exact prediction is the oracle, which shares no code. Seeds are fixed; |z| < 4 fails once in 16,000."""
    exact = LAWS[name].predict().emulated
    sampled = sampled_prediction(LAWS[name], precision=0.02, seed=1)
    assert abs(z_of(sampled, exact.system_error)) < 4.0
    low, high = sampled.node_intervals.T
    assert (np.abs(sampled.node_errors - exact.node_errors) <= 2.5 * (high - low) / 2.0 + 1e-12).all()


def of_links(count: int) -> Experiment:
    """The first of ten links of six agents, each up and down at rate 0.5, in steps of 0.05."""
    ends = [[i, i + 1] for i in range(1, 6)] + [[1, 3], [2, 4], [1, 6], [2, 5], [3, 6]]
    switching = {"links": {"up": 0.5, "down": 0.5}}
    return line_ring(6, graphs={"mesh": {"edges": ends[:count]}}, switching=switching)


@pytest.mark.parametrize(("count", "exact"), [(9, 3.41958), (10, 2.73584)])
def test_links_that_switch_by_themselves(count, exact):
    """Golden numbers of the chain on all 2^count graphs, by a dense solver. The seed is fixed; |z| < 4."""
    sampled = sampled_prediction(of_links(count), precision=0.02, seed=2)
    assert abs(z_of(sampled, exact)) < 4.0


@pytest.mark.parametrize(
    "changes", [{"noise": {"loss": 0.3}, "run": {"dt": 0.2}}, {"noise": HELD | {"delay": 1}, "run": REALTIME}]
)
def test_one_link_that_switches_makes_two_graphs(changes):
    """Line and ring of five agents: the exact prediction is the oracle. The seed is fixed; |z| < 4."""
    one = [[1, 5, 0.5]]
    links = {"up": {"default": 1.0, "edges": one}, "down": {"edges": one}}
    free = five(**changes, graphs={"ring": {"cycle": [1, 2, 3, 4, 5]}}, switching={"links": links})
    sampled = sampled_prediction(free, precision=0.02, seed=2)
    assert abs(z_of(sampled, five(**changes).predict().emulated.system_error)) < 4.0


@pytest.mark.parametrize(
    "changes",
    [
        {"time": "discrete", "noise": HELD | {"delay": 1}},
        {"time": "discrete", "noise": {"loss": 0.3}, **TRACKING},
        {"protocol": {"name": "metropolis"}, "noise": HELD, "run": REALTIME},
    ],
)
def test_messages_over_links_given_the_path(changes):
    """Three links: the exact prediction from their eight graphs is the oracle. The seed is fixed; |z| < 4."""
    links = {"up": 0.4, "down": 0.2}
    free = line_ring(3, **changes, graphs={"ring": {"cycle": [1, 2, 3]}}, switching={"links": links})
    exact, sampled = free.predict().emulated, sampled_prediction(free, precision=0.2, seed=2)
    assert abs(z_of(sampled, exact.system_error)) < 4.0
    low, high = sampled.node_intervals.T
    assert (np.abs(sampled.node_errors - exact.node_errors) <= 2.5 * (high - low) / 2.0).all()


def simulated(law: Experiment, paths: int, steps: int, rng: np.random.Generator) -> tuple[float, float]:
    """Mean of the system error after these steps from zero, and its standard error, forward in time."""
    pairs, change = law.written_graphs[0].edges, (1.0 - math.exp(-0.05)) / 2.0
    states, up = np.zeros((6, paths)), rng.random((len(pairs), paths)) < 0.5
    for _ in range(steps):
        pull = np.zeros_like(states)
        for there, (i, j, _) in zip(up, pairs, strict=True):
            pull[i - 1] += there * (states[j - 1] - states[i - 1])
            pull[j - 1] += there * (states[i - 1] - states[j - 1])
        states += 0.05 * pull + math.sqrt(0.05) * rng.standard_normal(states.shape)
        up ^= rng.random(up.shape) < change
    errors = ((states - states.mean(axis=0)) ** 2).sum(axis=0)
    return float(errors.mean()), float(errors.std() / math.sqrt(paths))


def test_a_simulation_forward_in_time_has_the_same_mean():
    """An oracle without adjoints: 1500 copies. Fixed seeds; |z| < 4 fails once in 16,000."""
    mean, error = simulated(of_links(7), 1500, 300, np.random.default_rng(5))
    sampled = sampled_prediction(of_links(7), precision=0.03, seed=3)
    own = (sampled.interval[1] - sampled.interval[0]) / 3.92
    assert abs(sampled.system_error - mean) < 4.0 * math.hypot(own, error)


def test_intervals_cover():
    """40 intervals of 95 %: fewer than 33 hold once in 1,000 (binomial). Fixed seeds."""
    exact = LAWS["tracking"].predict().emulated.system_error
    found = [sampled_prediction(LAWS["tracking"], precision=0.05, seed=100 + seed) for seed in range(40)]
    assert sum(low <= exact <= high for low, high in (one.interval for one in found)) >= 33


def test_the_same_for_the_same_seed_whatever_the_time():
    first, again = (sampled_prediction(five(), precision=0.05, within=within, seed=4) for within in (60.0, 1000.0))
    assert first.to_json()["emulated"] | {"seconds": 0} == again.to_json()["emulated"] | {"seconds": 0}
    assert sampled_prediction(five(), precision=0.05, seed=5).system_error != first.system_error


@pytest.mark.parametrize("name", ["held", "bursts"])
def test_the_same_whatever_the_workers(name):
    """To the last bit: the batches up to the first one that suffices, in the order of their numbers."""
    here, one, two = (
        sampled_prediction(LAWS[name], precision=0.01, seed=4, workers=workers) for workers in (None, 1, 2)
    )
    assert here.paths > 1000
    for other in (one, two):
        assert (other.interval, other.paths) == (here.interval, here.paths)
        assert other.node_intervals.tobytes() == here.node_intervals.tobytes()


def test_workers_say_what_is_wrong():
    with pytest.raises(InputError, match=r"within: 0.01 s: expected time for two samples"):
        sampled_prediction(five(), within=0.01, workers=1)
    late = line_ring(agents=4, **TRACKING, graphs={"all": {"complete": True}}, switching={}, noise={"delay": 1})
    with pytest.raises(InputError, match="steps are unstable"):
        sampled_prediction(late.with_run(dt=0.4), workers=1)


def test_walks_made_one_at_a_time(monkeypatch: pytest.MonkeyPatch):
    """As in large networks; fixed seed, |z| < 4 fails once in 16,000. Losses: arcs, not the matrices of the graphs."""
    monkeypatch.setattr(sampling, "MOST_TOGETHER", 1)
    for law in (directed(), directed(noise={"loss": 0.2})):
        sampled = sampled_prediction(law, precision=0.15, agents=[1], seed=1)
        assert abs(z_of(sampled, law.predict().emulated.system_error)) < 4.0


def test_without_matrices(monkeypatch: pytest.MonkeyPatch):
    """Where these do not fit in memory, experiments load, and errors are sampled: the same ones."""
    known = sampled_prediction(five(noise={"process": [1, 2, 1, 1, 1], "loss": 0.2}), precision=0.1)
    monkeypatch.setattr(limits, "available_memory", lambda: 3000)
    large = five(noise={"process": [1, 2, 1, 1, 1], "loss": 0.2}, run={"duration": 1})
    assert large.graph_list[0].symmetric
    assert sampled_prediction(large, precision=0.1).interval == known.interval
    for refused in (large.predict, large.simulate, lambda: large.leaders(1), lambda: describe_experiment(large)):
        with pytest.raises(NotAvailableError, match=r"graphs: 2 graphs of 5 agents need 3\.2 kB"):
            refused()
    apart = {"a": {"arcs": [[1, 2], [2, 3], [4, 3], [5, 4]]}, "b": {"arcs": [[2, 1]]}}
    with pytest.raises(ExperimentError, match=r"agents 4, 5 cannot be reached from agents 1, 2"):
        five(graphs=apart, switching={"rates": {"a": {"b": 1}, "b": {"a": 1}}}, run={"duration": 1})
    with pytest.raises(ExperimentError, match=r"run.dt: 0.5: expected less than 0.5"):
        five(run={"duration": 1, "dt": 0.5})


def test_single_agents():
    """Fixed seed; both intervals of 95 % hold three times as wide (|z| < 6)."""
    exact = five().predict().emulated
    sampled = sampled_prediction(five(), precision=0.05, agents=[2], seed=1)
    assert np.isnan(sampled.node_errors).tolist() == [True, False, True, True, True]
    assert sampled.node_errors[1] == pytest.approx(exact.node_errors[1], rel=0.15)
    assert sampled.system_error == pytest.approx(exact.system_error, rel=0.15)


def test_no_noise_no_error():
    assert sampled_prediction(five(noise={"process": 0.0})).interval == (0.0, 0.0)


def test_growing_walks_are_unstable_steps():
    fields = {"graphs": {"all": {"complete": True}}, "switching": {}, "noise": {"delay": 1}}
    late = line_ring(agents=4, **TRACKING | fields, run={"dt": 0.4})
    with pytest.raises(InputError, match="steps are unstable"):
        sampled_prediction(late)


def test_what_cannot_be_sampled():
    with pytest.raises(InputError, match=r"within: 1e-09 s: expected time for two samples at least"):
        sampled_prediction(five(), within=1e-9)
    with pytest.raises(InputError, match="precision: 2: expected a number above 0, below 1"):
        sampled_prediction(five(), precision=2.0)
    given = five(switching={"schedule": [[0, "line"], [1, "ring"]]}, run={"start": "zero"})
    with pytest.raises(NotAvailableError, match="expected a Markov chain"):
        sampled_prediction(given)
