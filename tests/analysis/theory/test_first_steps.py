"""The first steps with a delay, against the definition: every path of graphs and every loss, one after the other."""

import itertools
import math

import numpy as np
import pytest
import scipy.linalg

from experiments import Experiment, line_ring, predict
from msg_analysis.model.step_model import phases
from msg_analysis.theory.first_steps import known_start
from msg_analysis.theory.transient import solve_transient, transient

LINE = {"a": {"edges": [[1, 2, 0.6]]}, "b": {"arcs": [[3, 2], [2, 3, 0.5]]}}
PAIR = {"a": {"edges": [[1, 2, 0.6]]}, "b": {"arcs": [[1, 2, 0.5]]}}
ONE = {"loss": {"arcs": [[1, 2, 0.4]]}}
AIR = {"broadcast": 0.6, "link": 0.5}
MIXED = [[1.0, 0.4, 0.0], [0.0, 0.5, 0.2], [0.3, 0.0, 0.8]]
CASES = {
    "own": (PAIR, {"delay": 2, "loss": 0.4}, {}),
    "noise": (LINE, {"delay": 2, **AIR}, {}),
    "own, noise, correlated": (LINE, {"delay": 1, **ONE, **AIR, "process": MIXED}, {}),
    "own, bursts": (PAIR, {"delay": 2, "loss": 0.4, "burst": 3, **AIR}, {}),
    "held": (PAIR, {"delay": 1, **ONE, "on_loss": "hold", **AIR}, {}),
    "held, bursts": (PAIR, {"delay": 1, **ONE, "burst": 3, "on_loss": "hold", **AIR}, {}),
    "tracking": (PAIR, {"delay": 1, "loss": 0.4, **AIR}, {"leaders": {"agents": [1], "gain": 0.8, "reference": 1.0}}),
    "grounded": (PAIR, {"delay": 2, "loss": 0.4}, {"leaders": {"agents": [1], "gain": math.inf, "reference": 1.0}}),
    "real time": (LINE, {"delay": 1, **AIR, "process": MIXED}, {"pace": "realtime"}),
    "real time, own": (PAIR, {"delay": 2, "loss": 0.4, **AIR}, {"pace": "realtime"}),
    "real time, own, bursts": (PAIR, {"delay": 1, "loss": 0.4, "burst": 3, **AIR}, {"pace": "realtime"}),
    "real time, held": (PAIR, {"delay": 1, **ONE, "on_loss": "hold", **AIR}, {"pace": "realtime"}),
}


def parse(case, start=(1.0, -2.0, 0.5), switching=None):
    graphs, noise, more = CASES[case]
    agents = 3 if graphs is LINE else 2
    run = {"dt": 0.3, "duration": 6, "seed": 3, "pace": more.get("pace", "lockstep")}
    run["start"] = start if isinstance(start, str) else list(start[:agents])
    document = {"name": "case", "agents": agents, "graphs": graphs, "noise": noise, "run": run}
    document["switching"] = switching or {"generator": [[-2.0, 2.0], [3.0, -3.0]]}
    if "leaders" in more:
        document |= {"problem": "tracking", "leaders": more["leaders"]}
    return Experiment.parse(document)


def chain_paths(experiment, steps):
    """Every path of the graphs, and its probability."""
    chain, law = scipy.linalg.expm(experiment.step_length * experiment.chain.matrix), experiment.chain.stationary
    for path in itertools.product(range(2), repeat=steps):
        yield path, law[path[0]] * np.prod([chain[g, h] for g, h in itertools.pairwise(path)])


def by_outcomes(experiment, paths, start):
    """(steps + 1, m, m) E[x x^T] of the deviations; ``start`` (n, m, m): those at first, for every graph.

    ``paths``: the graphs of the steps, and the probability of this.
    """
    steps = len(paths[0][0])
    noise, m, dt = experiment.noise, experiment.agents, experiment.step_length
    held = np.isinf(experiment.leader_gains)
    weights = []
    for graph in experiment.graph_list:
        z = np.diag(graph.adjacency.sum(axis=1)) - graph.adjacency
        w = np.eye(m) - dt * (z + np.diag(np.where(held, 0.0, experiment.leader_gains)))
        w[held] = 0.0
        weights.append(w)
    process = np.array(noise.process, dtype=float) if isinstance(noise.process, list | tuple) else float(noise.process)
    gain = math.sqrt(dt) * (process * np.eye(m) if np.ndim(process) == 0 else process) * ~held[:, None]
    order = np.argsort(phases(experiment)) if experiment.run.pace == "realtime" else range(m)
    count = range(steps + 1)
    links = [(i, j) for i, j in itertools.permutations(range(m), 2) if any(w[i, j] for w in weights)]
    lossy = [link for link in links if experiment.loss[link] > 0.0]
    # Columns: x(0), process noise of every step, broadcast and link noise of every message, each of variance 1.
    columns = iter(range(10_000))
    first = [next(columns) for _ in range(m)]
    v = {(k, i): next(columns) for k in count for i in range(m)}
    b = {(k, j): next(columns) for k in count for j in range(m)}
    air = {(k, link): next(columns) for k in count for link in links}
    size, found = next(columns), np.zeros((steps + 1, m, m))

    def unit(column, scale=1.0):
        row = np.zeros(size)
        row[column] = scale
        return row

    def outcome(path, lost):
        x, history = [unit(entry) for entry in first], []
        said = {(0, j): x[j] + unit(b[0, j], noise.broadcast) for j in range(m)}
        for k in range(steps):
            history.append(x)
            before, x = x, list(x)
            for i in order:
                value = weights[path[k]][i, i] * before[i] + sum(unit(v[k, j], gain[i, j]) for j in range(m))
                for j in range(m):
                    if j == i or (i, j) not in links:
                        continue
                    stepped = experiment.run.pace == "realtime" and list(order).index(j) < list(order).index(i)
                    s = max(0, k - noise.delay + stepped)
                    while noise.holds and s and lost.get((s, (i, j))):
                        s -= 1
                    gone = lost.get((s, (i, j))) and not noise.holds
                    heard = before[i] if gone else said[s, j] + unit(air[s, (i, j)], noise.link)
                    value = value + weights[path[k]][i, j] * heard
                x[i] = value
            said |= {(k + 1, j): x[j] + unit(b[k + 1, j], noise.broadcast) for j in range(m)}
        return np.array([*history, x])

    messages = max(1, steps - noise.delay + 1)
    for gone in itertools.product([False, True], repeat=messages * len(lossy)):
        lost = dict(zip(itertools.product(range(messages), lossy), gone, strict=True))
        chance = 1.0
        for link in lossy:
            p, fate = experiment.loss[link], [lost[s, link] for s in range(messages)]
            mends = 1.0 / noise.burst if noise.burst else 1.0 - p
            fails = mends * p / (1.0 - p)
            chance *= p if fate[0] else 1.0 - p
            for old, new in itertools.pairwise(fate):
                chance *= ((1.0 - mends) if new else mends) if old else (fails if new else 1.0 - fails)
        for path, probability in paths:
            rows = outcome(path, lost)
            covariance = np.eye(size)
            covariance[:m, :m] = start[path[0]]
            found += chance * probability * (rows @ covariance @ rows.transpose(0, 2, 1))
    if experiment.problem == "consensus":
        centre = np.eye(m) - 1.0 / m
        found = centre @ found @ centre
    return found


STARTS = [(case, start) for case in CASES for start in ("known", "stationary")[: 1 + ("bursts" not in case)]]


@pytest.mark.parametrize(("case", "start"), STARTS)  # x(0) of a stationary start and bursts depend on each other
def test_transients_with_a_delay_are_those_of_every_outcome(case, start):
    experiment = parse(case) if start == "known" else parse(case, "stationary")
    steps = experiment.noise.delay + 2
    system = predict(experiment).system
    if start == "known":
        place = np.array(experiment.run.start) - experiment.reference
        moments = np.array([np.outer(place, place)] * 2)
    else:
        moments = system.by_graph(system.lifted(predict(experiment).steady))
        moments = moments / experiment.chain.stationary[:, None, None]
    expected = by_outcomes(experiment, list(chain_paths(experiment, steps)), moments)
    course = solve_transient(experiment, experiment.step_length * np.arange(steps + 1)).course
    found = course.mode_second_moments.sum(axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("agents", "noise", "words"),
    [
        (30, {"loss": 0.2}, "the losses of those to 30 agents"),
        (45, {"link": 0.2}, "their noise and losses"),
        (45, {"broadcast": 0.2}, None),  # of one message to all: few numbers
        (6, {"loss": 0.2, "on_loss": "hold"}, None),  # the message with x(0) is not lost
        (8, {"loss": 0.2, "delay": 0}, None),
    ],
)
def test_a_prediction_says_where_the_first_steps_are_approximate(agents, noise, words):
    run = {"dt": 0.01, "duration": 4, "start": "zero"}
    what = line_ring(
        agents, graphs={"all": {"complete": True}}, agents=agents, switching={}, noise={"delay": 1} | noise, run=run
    )
    notes = predict(what).to_json()["notes"]
    assert [words in note for note in notes] == [True] * (words is not None)


def test_what_is_left_out_of_the_first_steps_of_a_large_network():
    """The largest number of the table in docs/theory.md."""
    system = predict(line_ring(5, 0.5, noise={"delay": 20, "loss": 0.5})).system
    place = np.arange(5.0)[None] - 2.0
    starts = [known_start(system, place, system.stationary, most_numbers=most) for most in (2000, 0)]
    exact, near = (transient(system, start, np.array([21.0])).system_error[0] for start in starts)
    assert near / exact - 1.0 == pytest.approx(-0.26, abs=0.005)


@pytest.mark.parametrize("case", CASES)
def test_with_a_schedule(case):
    """The graphs change in the first steps, too."""
    path = (1, 0, 0, 1, 1)
    experiment = parse(case)
    path = path[: experiment.noise.delay + 3]
    schedule = [[0.3 * k, "ab"[g]] for k, g in enumerate(path)]
    experiment = parse(case, switching={"schedule": schedule}).with_run(duration=0.3 * len(path))
    place = np.array(experiment.run.start) - experiment.reference
    expected = by_outcomes(experiment, [(path, 1.0)], np.array([np.outer(place, place)] * 2))
    nodes = np.diagonal(expected, axis1=1, axis2=2)[1:]
    times = 0.3 * np.arange(len(path) + 1)
    course = solve_transient(experiment, times).course
    np.testing.assert_allclose(course.mode_second_moments.sum(axis=1), expected, rtol=1e-9, atol=1e-12)
    found = predict(experiment, start=0.3)
    np.testing.assert_allclose(found.path.system_errors, nodes.sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(found.emulated.node_errors, nodes[1:].mean(axis=0), rtol=1e-9, atol=1e-12)
