"""Evidence on the law of runs: each part against a computation by hand, false alarms, faults that are found."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from tests.support.watched_run import sums_of

from experiments import compare, five, line_ring, observed, predict, simulate
from msg_analysis.inference.evidence_sums import EvidenceSums, WatchedEvidence, any_time_evidence
from msg_analysis.inference.observation import spaced_steps
from msg_analysis.inference.pool import compare_pooled
from msg_analysis.inference.questions import QUESTIONS, evidence_weights
from msg_analysis.inference.system_error import ErrorMartingale
from msg_analysis.inference.verdict import Evidence
from msg_analysis.theory import packed_symmetric


def test_the_error_martingale_is_fair() -> None:
    """Over the next graph and the next state, by Gauss-Hermite quadrature, the factor of every rate has mean 1."""
    graphs = {"near": {"arcs": [[1, 2, 2.0], [2, 1, 1.0]]}, "far": {"arcs": [[1, 2, 0.3]]}}
    prediction = predict(line_ring(2, graphs=graphs, switching={"generator": [[-1, 1], [2, -2]]}, run={"dt": 0.1}))
    system = prediction.system
    nodes, weights = np.polynomial.hermite_e.hermegauss(120)
    weights = weights / weights.sum()
    for g in range(2):
        for y in (-3.0, 0.0, 0.4, 5.0):
            martingale = ErrorMartingale(prediction, 1)
            mean = np.zeros(len(martingale.rates))
            after = system.matrices[g, 0, 0] * y + np.sqrt(system.noise[g, 0, 0]) * nodes
            for j in range(2):
                for end, weight in zip(after, weights, strict=True):
                    a, b = (np.array([[packed_symmetric.pack(np.array([[v * v]]))[0], 1.0]]) for v in (y, end))
                    step = martingale.steps(np.array([g]), np.array([j]), a, b)[0]
                    mean += system.chain[g, j] * weight * np.exp(step)
            assert mean == pytest.approx(np.ones(len(mean)), abs=1e-8)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"noise": {"loss": 0.3, "link": 0.2, "broadcast": 0.1}},
        {"noise": {"delay": 2}},
        {"problem": "tracking", "leaders": {"agents": [2], "gain": 1.5, "reference": 3.0}},
    ],
    ids=["plain", "on the air", "delay", "leader"],
)
def test_sums_are_those_of_a_loop_over_the_steps(changes: dict[str, Any]) -> None:
    observation = observed(five(duration=12.0, **changes))
    sums = sums_of(observation, 50)
    step, noise = observation.step, observation.prediction.experiment.noise
    states = observation.states[:, :, 0]
    heard = states if observation.published is None else observation.published[:, :, 0]
    squares, score, information = np.zeros(5), np.zeros((5, 5)), np.zeros((5, 5))
    for k, g in enumerate(observation.modes.tolist()):
        for i in range(5):
            neighbours = step.neighbours(g, i).tolist()
            came = [observation.lost is None or not observation.lost[k, i, d] for d in range(len(neighbours))]
            parts = {
                j: step.nominal[g, i, j] * (heard[max(k - noise.delay, 0), j] - states[k, i])
                for j, there in zip(neighbours, came, strict=True)
                if there
            }
            parts[i] = (step.nominal[g, i].sum() - 1.0) * (states[k, i] - step.reference)
            variance = 0.05 + noise.link**2 * sum(step.nominal[g, i, j] ** 2 for j in parts if j != i)
            e = states[k + 1, i] - states[k, i] - sum(parts.values())
            squares[i] += e**2 / variance
            for j, part in parts.items():
                score[i, j] += part * e / variance
                information[i, j] += part**2 / variance
    assert sums.total.squares[0] == pytest.approx(squares)
    assert sums.total.link_score[0] == pytest.approx(score, abs=1e-9)
    assert sums.total.link_information[0] == pytest.approx(information, abs=1e-9)
    counts = np.zeros((2, 2))
    np.add.at(counts, (observation.modes[:-1], observation.modes[1:]), 1)
    assert (sums.total.counts[0] == counts).all()


@pytest.mark.parametrize(
    "changes",
    [{}, {"noise": {"loss": 0.3, "link": 0.2, "broadcast": 0.1}}, {"run": {"pace": "realtime"}}],
    ids=["lockstep", "on the air", "real time"],
)
def test_correct_runs_seldom_pass_at_any_time(changes: dict[str, Any]) -> None:
    """Of 30 runs, watched 100 times each, at level 10 %: false-alarm rate P(binomial(30, 0.1) > 8) = 0.2 %."""
    passed = 0
    for seed in range(30):
        observation = observed(five(seed=100 + seed, duration=25.0, **changes))
        watched = WatchedEvidence(observation, np.arange(5, observation.steps + 1, 5)).follow(observation)
        passed += bool((watched.logarithms >= np.log(10.0)).any())
    assert passed <= 8


ARCS = [[1, 2, 0.5], *([i, j, 1.0] for i, j in ((2, 1), (2, 3), (3, 2), (3, 4), (4, 3), (4, 5), (5, 4)))]
WEAK = {"line": {"arcs": ARCS}, "ring": {"arcs": [*ARCS, [5, 1, 1.0], [1, 5, 1.0]]}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise": {"process": [1, 1, 1.3, 1, 1]}}, "noise of agent 3"),
        ({"switching": {"generator": [[-1.0, 1.0], [0.5, -0.5]]}}, "switching away from line"),
        ({"graphs": WEAK}, "gain of the link from agent 1 to agent 2"),
    ],
)
def test_faults_are_found_and_named(changes: dict[str, Any], words: str) -> None:
    observation = observed(five(duration=600.0, **changes), five(duration=600.0))
    looks = np.arange(100, observation.steps + 1, 100)
    found = any_time_evidence(WatchedEvidence(observation, looks).follow(observation), 0.01)
    assert (found.exceeded, found.crossed is None, found.questions[0][0]) == (True, False, words)


def test_a_fault_of_the_system_error() -> None:
    """Its own martingale sees agents that have twice the noise variance, without asking for any agent."""
    observation = observed(five(duration=600.0, noise={"process": 2.0**0.5}), five(duration=600.0))
    assert sums_of(observation).families()["system error"].max() > np.log(1000.0)


def test_what_never_moves_is_infinite_evidence() -> None:
    still = five(noise={"process": [1.0, 0.0, 1.0, 1.0, 1.0]})
    assert sums_of(observed(five(noise={"process": [1.0, 0.01, 1.0, 1.0, 1.0]}), still)).evidence() == np.inf
    sums = sums_of(observed(still))
    assert sums.evidence() < 20.0
    assert "residuals: covariance" in sums.families()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"run": {"replicas": 3}},
        {"noise": {"loss": 0.3, "link": 0.2, "broadcast": 0.1}},
        {"noise": {"process": [1.0, 0.0, 1.0, 1.0, 1.0], "delay": 2}},
        {"noise": {"loss": 0.3, "on_loss": "hold", "link": 0.2}},
        {"noise": {"process": [[1.0, 0.5, 0, 0, 0]] * 5, "loss": 0.3, "on_loss": "hold", "link": 0.2}},
        {"run": {"pace": "realtime"}},
    ],
    ids=[
        "plain",
        "replicas",
        "on the air",
        "an agent without noise",
        "messages used again",
        "not followed",
        "real time",
    ],
)
def test_many_looks_in_one_pass_are_those_of_a_pass_each(changes: dict[str, Any]) -> None:
    """With residuals that are too large, and an agent that stands still; also in the pass of the residuals."""
    observation = observed(five(duration=40.0, **changes))
    observation.states[301, 2] += 3.0
    observation.states[401:407, 3] = observation.states[400, 3]
    looks = spaced_steps(observation.steps, 20)  # so many of a run of 800 steps
    sums, one_by_one = EvidenceSums(observation.prediction, observation.replicas, in_detail=True), []
    for first, last in pairwise([0, *looks.tolist()]):
        sums.add(observation, first, last)
        one_by_one.append(sums.evidence())
    for watched in (WatchedEvidence(observation, looks).follow(observation), Evidence.of(observation, 0.01).watched):
        np.testing.assert_array_equal(watched.steps, looks)
        np.testing.assert_allclose(watched.logarithms, one_by_one, rtol=1e-9, atol=1e-9)
        for kind, logarithms in sums.families().items():
            assert watched.sums.families()[kind] == pytest.approx(logarithms, rel=1e-9, abs=1e-9), kind


def test_in_a_comparison() -> None:
    comparison = compare(simulate(five(duration=200.0)))
    document = comparison.to_json()["any_time"]
    assert [document[key] for key in ("exceeded", "crossed_at", "threshold")] == [False, None, 100.0]
    assert document["evidence"] == pytest.approx(np.exp(document["log_evidence"]))
    logs = [entry["log_evidence"] for entry in document["questions"]]
    assert logs == sorted(logs, reverse=True)
    half = 0.5 * (comparison.system_error.interval[1] - comparison.system_error.interval[0])
    assert half < document["half_width"] < 2.5 * half  # wider, since it holds at all times


def test_runs_together_are_one_game() -> None:
    """Sums are added up, and looked at once."""
    truth = [simulate(five(seed=seed, duration=300.0)) for seed in (1, 2)]
    apart = [compare(run).any_time for run in truth]
    both = compare_pooled([("one", truth[0]), ("two", truth[1])]).any_time
    assert both.time is None
    sums = [sums_of(observed(run), in_detail=True) for run in truth]
    sums[0].merge(sums[1])
    assert both.log_evidence == pytest.approx(sums[0].evidence())
    assert all(alone is not None and np.isfinite(alone.log_evidence) for alone in apart)


def test_questions_of_single_parts_keep_their_share() -> None:
    """Weights are fixed, of sum 1, and those of the main kinds do not depend on how many others there are."""
    assert evidence_weights([True, False, True]) == pytest.approx([0.375, 0.25, 0.375])
    assert evidence_weights([True, False, True, False, False]) == pytest.approx([0.375, 1 / 12, 0.375, 1 / 12, 1 / 12])
    assert evidence_weights([True]) == pytest.approx([1.0])
    assert evidence_weights([False, False]) == pytest.approx([0.5, 0.5])
    names = ["residuals: covariance", "residuals: gains", "switching", "loss"]
    assert [question.name for question in QUESTIONS if question.main] == names
