"""Causes that are named for runs in which one thing is wrong, and selection against plain least squares."""

import dataclasses

import numpy as np
import pytest
from scipy import optimize, stats

from experiments import Experiment, RunRecord, compare, new_record, simulate
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.inference.candidates import Candidate, find_rates, select
from msg_analysis.twin.simulate import states_of_all

PAIRS = {"line": [(1, 2), (2, 3), (3, 4)], "ring": [(1, 2), (2, 3), (3, 4), (4, 1)]}


def graphs(gain=lambda sender, receiver, graph: 1.0):
    """Arc by arc; arcs of gain 0 are left out."""
    found = {}
    for name, pairs in PAIRS.items():
        both = [arc for i, j in pairs for arc in ((i, j), (j, i))]
        found[name] = {"arcs": [[i, j, gain(i, j, name)] for i, j in both if gain(i, j, name) > 0]}
    return found


BASE = {
    "name": "square",
    "agents": 4,
    "graphs": graphs(),
    "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
    "noise": {"process": 1.0},
    "run": {"dt": 0.1, "duration": 100, "replicas": 32, "seed": 11},
}
LEADERS = {"agents": [1, 3], "gain": 1.0, "reference": 2.0}
TRACKING = BASE | {"problem": "tracking", "leaders": LEADERS}
AIR = BASE | {"noise": {"process": 1.0, "loss": 0.1, "broadcast": 0.2}}


def misrecorded(truth, said=BASE):
    """A run of one law whose record says another; losses that the record does not know are not logged."""
    true, record = Experiment.parse(truth), new_record(Experiment.parse(said))
    trajectory = simulate(true, record=RunRecord(record.run, true, record.start))
    lost = trajectory.lost if record.experiment.noise.loss.any else None
    return dataclasses.replace(trajectory, record=record, lost=lost)


def weaker(factor, *, sender=None, receiver=None, graph=None):
    def gain(i, j, name):
        hit = sender in (None, i) and receiver in (None, j) and graph in (None, name)
        return factor if hit else 1.0

    return {"graphs": graphs(gain)}


def noise(**changes):
    return {"noise": {"process": 1.0} | changes}


def rates(line, ring):
    return {"switching": {"generator": [[-line, line], [ring, -ring]]}}


CASES = {  # what the record claims, what is otherwise, the cause (kind, agent, link, graph), its size, the best test
    "noise of an agent": (BASE, noise(process=[1.0, 1.1, 1.0, 1.0]), ("noise", 2, None, None), 1.21, "covariance"),
    "noise of all": (BASE, noise(process=1.05), ("noise", None, None, None), 1.1025, "covariance"),
    "noise under a graph": (
        *(BASE, noise(process={"line": 1.0, "ring": 1.08}), ("noise", None, None, "ring"), 1.08**2, "noise by graph"),
    ),
    "one link": (BASE, weaker(0.7, sender=2, receiver=3), ("gain", None, (2, 3), None), 0.7, "gains"),
    "one link of a graph": (
        *(BASE, weaker(0.5, sender=1, receiver=2, graph="line"), ("gain", None, (1, 2), "line"), 0.5, "gains"),
    ),
    "what an agent hears": (BASE, weaker(0.7, receiver=3), ("gain", 3, None, None), 0.7, "gains"),
    "messages of an agent": (BASE, weaker(0.7, sender=2), ("ignored", 2, None, None), 0.3, "gains"),
    "messages ignored": (BASE, noise(loss=0.1), ("ignored", None, None, None), 0.1, "common gain"),
    "all gains too large": (BASE, weaker(1.2), ("gain", None, None, None), 1.2, "common gain"),
    "a leader's gain": (TRACKING, {"leaders": LEADERS | {"gain": 1.3}}, ("gain", None, None, None), 1.3, "gains"),
    "reference": (TRACKING, {"leaders": LEADERS | {"reference": 2.3}}, ("reference", None, None, None), 2.3, "gains"),
    "a rate": (BASE, rates(2.0, 0.5), ("switching", None, None, ["line", "ring"]), 2.0, "switching"),
    "all rates": (BASE, rates(1.5, 1.5), ("switching", None, None, None), 3.0, "switching"),
    "more loss": (AIR, noise(loss=0.2, broadcast=0.2), ("loss", None, None, None), 0.2, "loss"),
    "broadcast noise": (AIR, noise(loss=0.1, broadcast=0.21), ("broadcast", None, None, None), 1.05**2, "broadcast"),
    "correlated noise": (
        BASE,
        noise(process=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0.2, 0.96**0.5, 0], [0, 0, 0, 1]]),
        *(("correlation", None, (2, 3), None), 0.2, "covariance"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_the_first_cause(case):
    """Fixed seeds; every fault is six standard errors large, and is to be estimated within four of them."""
    # Apart from the errors, which show every fault, the test that is made for it is the clearest.
    claimed, change, said, truth, found_by = CASES[case]
    result = compare(misrecorded(claimed | change, claimed))
    assert (result.verdict, result.exit_code) == ("disagrees", 1)
    special = [test for test in result.tests if "error" not in test.name and test.name != "covariance"]
    assert min(special, key=lambda test: test.p).name.removeprefix("residuals: ") == found_by
    first = result.causes[0]
    assert (first.kind, first.agent, first.link, first.graph) == said, [cause.words for cause in result.causes]
    low, high = first.interval
    assert low < first.estimate < high
    assert abs(first.estimate - truth) < 2.05 * (high - low) / 2
    assert first.p < 0.01
    assert result.to_json()["causes"][0]["words"] == first.words


def test_a_frozen_agent_is_the_only_cause():
    """What follows from it, in gains and noise, is not listed."""
    still = weaker(0.0, receiver=3) | noise(process=[1.0, 1.0, 0.0, 1.0])
    (cause,) = compare(misrecorded(BASE | still)).causes
    assert (cause.kind, cause.agent, cause.estimate, cause.p) == ("frozen", 3, 1.0, 0.0)
    assert cause.words == "agent 3 does not move in any of its steps, although it has noise"


def test_an_agent_that_freezes_for_a_while():
    trajectory = misrecorded(BASE)
    trajectory.states[400:500, 1] = trajectory.states[400, 1]
    first = compare(trajectory).causes[0]
    assert (first.kind, first.agent, first.estimate) == ("frozen", 2, pytest.approx(99 / 1000))


def test_two_faults_are_both_found():
    both = noise(process=[1.0, 1.1, 1.0, 1.0]) | weaker(0.6, sender=2, receiver=3)
    causes = compare(misrecorded(BASE | both)).causes
    assert {(cause.kind, cause.agent, cause.link) for cause in causes} == {("noise", 2, None), ("gain", None, (2, 3))}


THREE = BASE | {
    "graphs": graphs() | {"star": {"star": {"center": 1}}},
    "switching": {"generator": [[-1.0, 0.5, 0.5], [0.2, -0.4, 0.2], [1.0, 1.0, -2.0]]},
}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", [1, 2])
def test_correlated_noise_in_real_time(sign, seed):
    """It is in what is received, but it is no gain, and no share of stale values below 0."""
    claimed = BASE | {"run": BASE["run"] | {"pace": "realtime", "seed": seed}}
    both = noise(process=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0.3 * sign, 0.91**0.5, 0], [0, 0, 0, 1]])
    causes = compare(misrecorded(claimed | both, claimed)).causes
    assert [(cause.kind, cause.link) for cause in causes] == [("correlation", (2, 3))]


@pytest.mark.parametrize(
    ("claimed", "means", "names"),
    [
        (BASE, [1, 0], ["line", "ring"]),
        (TRACKING, [1, 0], ["line", "ring"]),
        (THREE, [2, 1, 0], ["line", "star"]),
        (THREE, [1, 2, 0], ["line", "ring", "star"]),
    ],
)
def test_names_of_the_graphs_in_the_whole_run(claimed, means, names):
    """All other causes, as gains and rates, follow from it; whichever law of the chain, names or rates, is right."""
    run = simulate(Experiment.parse(claimed | {"run": claimed["run"] | {"replicas": 2}}))
    (cause,) = compare(dataclasses.replace(run, modes=np.argsort(means)[run.modes])).causes
    assert (cause.kind, cause.graph, cause.p) == ("graph", names, pytest.approx(0.0, abs=1e-9))
    assert cause.words.startswith("the log has the names of the graphs ")
    assert "in the whole run" in cause.words


RINGS = THREE | {
    "graphs": {
        name: {"edges": list(zip(ring, ring[1:] + ring[:1], strict=True))}
        for name, ring in {"a": [1, 2, 3, 4], "b": [1, 3, 2, 4], "c": [1, 2, 4, 3]}.items()
    }
}


@pytest.mark.parametrize(
    "messages",
    [
        {"broadcast": 0.3, "link": 0.3},
        {"loss": 0.3, "link": 0.3},
        {"loss": 0.3, "on_loss": "hold", "delay": 1},
        {"loss": 0.2, "broadcast": 0.2, "link": 0.2, "delay": 2},
    ],
    ids=" ".join,
)
def test_names_of_the_graphs_with_noise_loss_and_delay_of_messages(messages):
    """Three rings, so that the log says of each neighbour what was received, whichever it is."""
    claimed = RINGS | noise(**messages) | {"run": BASE["run"] | {"replicas": 2, "duration": 50}}
    run = simulate(Experiment.parse(claimed))
    assert "residuals: swapped graphs" not in {test.name for test in compare(run).tests if test.rejected}
    (cause,) = compare(dataclasses.replace(run, modes=np.argsort([1, 2, 0])[run.modes])).causes
    assert (cause.kind, cause.graph) == ("graph", ["a", "b", "c"])
    assert cause.words.endswith("in the whole run: a means b, b means c, c means a")


@pytest.mark.parametrize("alike", [range(32), [2, 5]])
def test_replicas_that_are_alike(alike):
    run = misrecorded(BASE)
    for values in (run.states, run.record.start):
        values[..., alike] = values[..., [alike[0]]]
    result = compare(run)
    (cause,) = result.causes
    which = "all replicas" if len(alike) > 2 else "replicas 3 and 6"
    assert (cause.kind, cause.agent, cause.estimate) == ("replicas", None, pytest.approx(1.0))
    assert cause.interval[1] <= 1.0
    assert cause.words.startswith(f"the noise of {which} has correlation 1.00 (1.00 to 1.00), not 0")
    assert result.any_time.exceeded
    assert "replicas" in result.any_time.questions[0][0]


CHAIN = [[0.5, 0.25, 0.25], [0.3, 0.5, 0.2], [0.2, 0.2, 0.6]]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_chain_of_second_order(seed):
    """After a jump the graph seldom goes back to where it came from; each graph comes as often as before."""
    truth = BASE | {
        "graphs": THREE["graphs"],
        "time": "discrete",
        "switching": {"transition": CHAIN},
        "run": {"duration": 3000, "replicas": 1, "seed": seed},
    }
    record = new_record(Experiment.parse(truth))
    random, path = np.random.default_rng(seed), [0, 1]
    while len(path) < 3000:
        before, now = path[-2:]
        law = np.array(CHAIN[now])
        if before != now:
            law[[before, 3 - before - now]] += [-0.12, 0.12]
        path.append(int(random.choice(3, p=law)))
    modes, model = np.array(path), record.model
    states = np.concatenate([record.start[None], *states_of_all(record.experiment, model, modes, record.start)])
    run = dataclasses.replace(simulate(record.experiment, record=record), states=states, modes=modes)
    result = compare(run)
    first = result.causes[0]
    assert (first.kind, len(first.graph)) == ("second order", 3)
    low, high = first.interval
    assert 0.0 <= low < first.estimate < high <= 1.0
    assert not low < first.expected < high
    assert [test.name for test in result.tests if test.rejected] == ["graph before"]


def test_another_start_than_in_the_record():
    run = simulate(Experiment.parse(BASE | {"run": BASE["run"] | {"start": [0.0, 1.0, 2.0, 3.0]}}))
    run.record.start[2, 1] = 2.5
    result = compare(run)
    assert [test.name for test in result.tests if test.rejected and "error" not in test.name] == ["start"]
    first = result.causes[0]
    assert (first.kind, first.agent, first.estimate, first.expected) == ("start", 3, 2.0, 2.5)
    assert first.words == "agent 3, replica 2, starts at 2.0, not at 2.5 as in the record of the run"


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_a_held_leader_off_its_reference(time):
    """In discrete time it has noise; the other leader is right."""
    chain = {"discrete": {"time": "discrete", "switching": {"transition": [[0.5, 0.5], [0.5, 0.5]]}}}.get(time, {})
    document = TRACKING | chain | {"leaders": {"agents": [1, 3], "gain": "inf", "reference": 2.0}}
    experiment = Experiment.parse(document | {"run": {"duration": 400 if chain else 40, "replicas": 4}})
    run = simulate(experiment)
    offsets = np.repeat(run.record.model.offsets, 1, axis=0)
    offsets[:, 2] += 0.3
    changed = dataclasses.replace(run.record.model, offsets=offsets)
    blocks = states_of_all(experiment, changed, run.modes, run.record.start)
    causes = compare(dataclasses.replace(run, states=np.concatenate([run.states[:1], *blocks]))).causes
    first = causes[0]
    assert (first.kind, first.agent, first.expected) == ("reference", 3, 2.0)
    assert first.estimate == pytest.approx(2.3, abs=0.1)
    assert "not " in first.words
    assert "the reference 2" in first.words


def test_a_forbidden_jump():
    discrete = BASE | {
        "graphs": graphs() | {"star": {"star": {"center": 1}}},
        "time": "discrete",
        "switching": {"transition": [[0.5, 0.5, 0.0], [0.3, 0.4, 0.3], [0.0, 0.5, 0.5]]},
        "run": {"duration": 300, "replicas": 1, "seed": 2},
    }
    truth = discrete | {"switching": {"transition": [[0.5, 0.4, 0.1], [0.3, 0.4, 0.3], [0.0, 0.5, 0.5]]}}
    causes = compare(misrecorded(truth, discrete)).causes
    assert causes[0].graph == ["line", "star"]
    assert "excludes" in causes[0].words


CLASSES = [[Candidate("one", i, row) for i, row in enumerate(np.eye(6))], [Candidate("all", None, np.ones(6))]]


def test_selection_is_generalised_least_squares():
    random = np.random.default_rng(4)
    design = random.standard_normal((300, 6))
    true = np.array([0.0, 1.0, 0.0, 0.0, -0.8, 0.0])
    y = design @ true + random.standard_normal(300)
    score, information = design.T @ y, design.T @ design
    found, change = select(score, information, CLASSES, 2, 0.01)
    assert sorted((one.part, one.what) for one in found) == [("one", 1), ("one", 4)]
    both = design[:, [1, 4]]
    fit, inverse = np.linalg.lstsq(both, y, rcond=None)[0], np.linalg.inv(both.T @ both)
    estimates = {one.what: (one.estimate, one.standard_error) for one in found}
    assert estimates[1] == pytest.approx((fit[0], inverse[0, 0] ** 0.5))
    assert estimates[4] == pytest.approx((fit[1], inverse[1, 1] ** 0.5))
    np.testing.assert_allclose(change[[1, 4]], fit)
    assert not change[[0, 2, 3, 5]].any()


def test_nothing_is_selected_where_nothing_is_wrong():
    """1000 draws, level 0.05: binomial at 1e-4."""
    random = np.random.default_rng(5)
    root = random.standard_normal((6, 6))
    wrong = 0
    for _ in range(1000):
        wrong += bool(select(root @ random.standard_normal(6), root @ root.T, CLASSES, 2, 0.05)[0])
    assert wrong <= stats.binom.isf(1e-4, 1000, 0.05)


def test_rates_are_the_likeliest():
    """One probability of a discrete chain: its likelihood and interval in closed form, with scipy's root finder."""
    counts = np.array([[700, 200], [150, 350]])
    chain = MarkovChain("discrete", np.array([[0.9, 0.1], [0.3, 0.7]]))
    (rate,) = find_rates(counts, chain, 1.0, 1, 0.01)
    assert rate.jumps == ((0, 1),)
    assert rate.factor * 0.1 == pytest.approx(200 / 900, rel=1e-5)

    def less(p):
        return 200 * np.log(200 / 900 / p) + 700 * np.log(700 / 900 / (1 - p)) - stats.chi2.ppf(0.95, 1) / 2

    ends = [optimize.brentq(less, 1e-3, 200 / 900), optimize.brentq(less, 200 / 900, 0.9)]
    assert np.multiply(rate.interval, 0.1) == pytest.approx(ends, rel=1e-4)


def test_rates_in_continuous_time():
    """Twice the rates: P = expm(2 Gamma dt), so factor 2, exactly where the counts are its expectation."""
    chain = MarkovChain("continuous", np.array([[-1.0, 1.0], [3.0, -3.0]]))
    faster = MarkovChain("continuous", 2 * chain.matrix).transition(0.1)
    counts = np.rint(faster * [[300_000], [100_000]]).astype(int)
    (rate,) = find_rates(counts, chain, 0.1, 1, 0.01)
    assert (len(rate.jumps), rate.origin, rate.factor) == (2, None, pytest.approx(2.0, rel=1e-3))
