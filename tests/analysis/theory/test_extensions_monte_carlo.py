"""What lies beyond the paper, against simulation: message by message, in a simulator of its own.

Many independent networks, each with its own path of graphs, start at agreement and take so many steps that the start
is forgotten. The squared deviations at the end are independent samples: z = (mean - prediction) / standard error, for
every agent and for their sum. |z| < 4 for each; with 6 numbers a case, a right program fails a case with probability
below 4e-4.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.linalg

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict

NETWORKS = 6000
STEPS = 90  # what is then left of the start at 0 is below a tenth of a percent: a twentieth of a standard error
DT = 0.3
CORRELATED = [
    [1.0, 0.0, 0.0, 0.0, 0.5],
    [-0.7, 0.6, 0.0, 0.0, 0.0],
    [0.0, 0.0, 0.3, 0.0, 0.0],
    [0.0, 2.0, 0.0, 0.1, 0.0],
    [0.0, 0.0, 0.0, 0.0, 0.0],
]
LINE_RING = {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}}
WEIGHTED = {"a": {"edges": [[1, 2, 0.3], [2, 3, 1.7], [3, 4, 0.6], [4, 5, 1.1]]}, "b": {"edges": [[1, 5, 2.0]]}}
DIRECTED = {"a": {"arcs": [[1, 2], [2, 3], [3, 1], [3, 4, 0.5], [4, 5]]}, "b": {"arcs": [[5, 1, 1.5], [1, 4]]}}
DISCONNECTED = {"left": {"edges": [[1, 2], [2, 3]]}, "right": {"edges": [[3, 4], [4, 5]]}}
BY_GRAPH = {"a": 0.4, "b": CORRELATED}
AIR = {"broadcast": 0.5, "link": 0.4, "loss": 0.25, "delay": 2}
CASES = {
    "noise by graph": (LINE_RING, {"process": {"line": 0.2, "ring": CORRELATED}}, {}),
    "broadcast": (LINE_RING, {"process": 0.2, "broadcast": 1.0}, {}),
    "link": (LINE_RING, {"process": 0.2, "link": 1.0}, {}),
    "loss": (LINE_RING, {"loss": 0.4}, {}),
    "weighted": (WEIGHTED, {}, {}),
    "directed": (DIRECTED, {}, {}),
    "disconnected": (DISCONNECTED, {}, {}),
    "delay": (LINE_RING, {"delay": 3}, {}),
    "delay, directed, by graph": (DIRECTED, {"delay": 2, "process": BY_GRAPH}, {}),
    "loss of noisy values": (WEIGHTED, {"loss": 0.3, "broadcast": 0.8, "link": 0.5}, {}),
    "everything": (DIRECTED, AIR | {"process": BY_GRAPH}, {}),
    "everything, followers": (DIRECTED, AIR | {"process": BY_GRAPH}, {"agents": [2, 5], "gain": 0.8}),
    "everything, held leaders": (DIRECTED, AIR | {"process": BY_GRAPH}, {"agents": [3], "gain": math.inf}),
    "everything, discrete time": (WEIGHTED, AIR | {"process": BY_GRAPH}, {"agents": [1], "gain": 1.5}),
}


def parse(case):
    graphs, noise, leaders = CASES[case]
    given = {"name": "case", "agents": 5, "graphs": graphs, "noise": noise}
    if leaders:
        given |= {"problem": "tracking", "leaders": leaders}
    if "discrete" in case:
        given |= {"time": "discrete", "switching": {"transition": [[0.8, 0.2], [0.4, 0.6]]}, "run": {"duration": 5}}
    else:
        given |= {"switching": {"generator": [[-2.0, 2.0], [3.0, -3.0]]}, "run": {"dt": DT, "duration": 3}}
    return Experiment.parse(given)


def jumped(random, modes, transition):
    """The next graph of every network."""
    after = (random.random(len(modes))[:, None] > np.cumsum(transition, axis=1)[modes]).sum(axis=1)
    return np.minimum(after, len(transition) - 1)


def steps_of(experiment, process):
    """(weights, own part included; process noise) of every graph, from the experiment alone."""
    m, gains = experiment.agents, experiment.leader_gains
    held = np.isinf(gains)
    laplacians = [np.diag(graph.adjacency.sum(axis=1)) - graph.adjacency for graph in experiment.graph_list]
    z = np.stack(laplacians) + np.diag(np.where(held, 0.0, gains))
    gain = np.stack([f * np.eye(m) if np.isscalar(f) else np.array(f) for f in process])
    if experiment.time == "discrete":
        return np.stack([scipy.linalg.expm(-a) for a in z]), gain
    weights, gain = np.eye(m) - DT * z, math.sqrt(DT) * gain
    weights[:, held], gain[:, held] = 0.0, 0.0
    return weights, gain


def squared_deviations(experiment, process, seed):
    """(NETWORKS, m) at the end."""
    random = np.random.default_rng(seed)
    m, noise = experiment.agents, experiment.noise
    weights, gain = steps_of(experiment, process)
    own = np.diagonal(weights, axis1=1, axis2=2).copy()
    coupling = weights * ~np.eye(m, dtype=bool)
    chain = experiment.chain.matrix
    transition = chain if experiment.time == "discrete" else scipy.linalg.expm(DT * chain)
    modes = np.zeros(NETWORKS, dtype=int)
    past = [np.zeros((NETWORKS, m))] * (noise.delay + 1)  # x(k), x(k - 1), ...
    for _ in range(STEPS):
        x = past[0]
        sent = past[-1]
        if noise.broadcast:
            sent = sent + noise.broadcast * random.standard_normal(x.shape)
        pull = sent[:, None, :]
        if noise.link:
            pull = pull + noise.link * random.standard_normal((NETWORKS, m, m))
        if noise.loss:  # a lost value is replaced by one's own
            pull = np.where(random.random((NETWORKS, m, m)) >= noise.loss.default, pull, x[:, :, None])
        drawn = random.standard_normal(x.shape)
        moved = own[modes] * x + np.einsum("rab,rab->ra", coupling[modes], pull)
        moved += np.einsum("rab,rb->ra", gain[modes], drawn)
        past = [moved, *past[:-1]]
        modes = jumped(random, modes, transition)
    deviation = past[0] - (past[0].mean(axis=1, keepdims=True) if experiment.problem == "consensus" else 0.0)
    return deviation**2


def assert_agrees(samples, moments):
    both = np.column_stack([samples, samples.sum(axis=1)])
    expected = np.append(moments.node_errors, moments.system_error)
    spread = both.std(axis=0, ddof=1) / math.sqrt(len(both))
    exact = spread == 0.0
    np.testing.assert_array_equal(both.mean(axis=0)[exact], expected[exact])
    z = (both.mean(axis=0) - expected)[~exact] / spread[~exact]
    assert np.abs(z).max() < 4, z


@pytest.mark.parametrize("case", CASES)
def test_simulated_messages(case):
    experiment = parse(case)
    process = CASES[case][1].get("process", 1.0)
    process = list(process.values()) if isinstance(process, dict) else [process] * 2
    samples = squared_deviations(experiment, process, seed=list(CASES).index(case))
    assert_agrees(samples, predict(experiment).emulated)


def test_noise_by_graph_enters_before_the_jump():
    """With pi_i N_i in place of sum_j P_ji pi_j N_j, this case would be off by many standard errors.

    The loud graph has no links, and is mostly followed by the one that smooths.
    """
    given = {
        "name": "order",
        "time": "discrete",
        "agents": 5,
        "graphs": {"loud": {"edges": []}, "smooth": {"complete": True}},
        "switching": {"transition": [[0.1, 0.9], [0.9, 0.1]]},
        "noise": {"process": {"loud": 1.0, "smooth": 0.1}},
        "run": {"duration": 5},
    }
    experiment = Experiment.parse(given)
    prediction = predict(experiment)
    step = prediction.step
    wrong = np.zeros_like(prediction.emulated.by_mode)
    centre = np.eye(5) - 1 / 5
    for _ in range(2000):
        after = centre @ step.weights @ wrong @ step.weights.transpose(0, 2, 1) @ centre
        wrong = np.tensordot(step.transition, after, axes=(0, 0))
        wrong += step.stationary[:, None, None] * (centre @ step.noise @ centre)
    samples = squared_deviations(experiment, [1.0, 0.1], seed=0)
    assert_agrees(samples, prediction.emulated)
    totals = samples.sum(axis=1)
    error = totals.std(ddof=1) / math.sqrt(NETWORKS)
    assert abs(totals.mean() - np.trace(wrong.sum(axis=0))) > 10 * error


def test_bursts_of_losses_are_graphs():
    """Two Gilbert-Elliott channels in a ring of three: good ones deliver, bad ones lose, and both states last.

    The channels are simulated as channels; the prediction has them as four graphs and the sum of two generators.
    """
    fail, mend, link = 0.4, 0.9, [(1, 2), (3, 1)]  # rates; the directed links with channels
    sure = [(2, 1), (2, 3), (3, 2), (1, 3)]
    present = list(itertools.product([True, False], repeat=2))
    graphs = {
        str(there): {"arcs": [[*arc] for arc in sure + [a for a, up in zip(link, there, strict=True) if up]]}
        for there in present
    }
    channel = np.array([[-fail, fail], [mend, -mend]])
    generator = np.kron(channel, np.eye(2)) + np.kron(np.eye(2), channel)
    given = {
        "name": "bursts",
        "graphs": graphs,
        "switching": {"generator": generator.tolist()},
        "run": {"dt": DT, "duration": 3},
    }
    random = np.random.default_rng(99)
    stays = 1 - math.exp(-(fail + mend) * DT)
    good_to_bad, bad_to_good = fail / (fail + mend) * stays, mend / (fail + mend) * stays
    x, good = np.zeros((NETWORKS, 3)), np.ones((NETWORKS, 2), dtype=bool)
    for _ in range(STEPS):
        pull = np.zeros_like(x)
        for source, target in sure:
            pull[:, target - 1] += x[:, source - 1] - x[:, target - 1]
        for c, (source, target) in enumerate(link):
            pull[:, target - 1] += np.where(good[:, c], x[:, source - 1] - x[:, target - 1], 0.0)
        x = x + DT * pull + math.sqrt(DT) * random.standard_normal(x.shape)
        draw = random.random(good.shape)
        good = np.where(good, draw >= good_to_bad, draw < bad_to_good)
    assert_agrees((x - x.mean(axis=1, keepdims=True)) ** 2, predict(Experiment.parse(given)).emulated)
