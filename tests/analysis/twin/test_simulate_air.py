"""The twin with noise and loss on the air: against a loop over numbers, against single agents, and moments."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.stats

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.reception import LOST
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import build_step_model
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

SEED, BLOCK = 5, 256
BROADCAST, LINK, LOSS = 4, 5, 6  # numbers of the streams
AIRS = {
    "broadcast": {"broadcast": 0.3},
    "link": {"link": 0.2},
    "loss": {"loss": 0.3},
    "all": {"broadcast": 0.3, "link": 0.2, "loss": 0.3},
}
LAWS: dict[str, dict[str, Any]] = {
    "consensus": {"graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"arcs": [[1, 3, 0.5], [4, 1], [2, 4], [3, 1]]}}},
    "tracking": {
        "problem": "tracking",
        "graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"star": {"center": 2}}},
        "leaders": {"agents": [2], "gain": 0.7, "reference": 2.5},
    },
    "grounded": {
        "problem": "tracking",
        "graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"cycle": [1, 2, 3, 4]}},
        "leaders": {"agents": [3], "gain": float("inf"), "reference": -1.0},
    },
    "discrete": {"time": "discrete", "graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"star": {"center": 1}}}},
    "leaders of discrete time alone heard": {
        "problem": "tracking",
        "time": "discrete",
        "graphs": {"a": {"star": {"center": 1}}, "b": {"star": {"center": 1}}},
        "leaders": {"agents": [1], "gain": float("inf")},
    },
}


def experiment(law: str, air: str, **run: Any) -> Experiment:
    document: dict[str, Any] = {"name": "air", "agents": 4, **LAWS[law]}
    discrete = document.get("time") == "discrete"
    chain = {"transition": [[0.9, 0.1], [0.3, 0.7]]} if discrete else {"generator": [[-1.0, 1.0], [2.0, -2.0]]}
    dt, steps = (1.0, 300) if discrete else (0.1, 300)
    times = {"dt": dt, "duration": steps * dt, "replicas": 2, "seed": SEED}
    return Experiment.parse(document | {"switching": chain, "noise": {"process": 0.5, **AIRS[air]}, "run": times | run})


def philox(stream: int, number: int, block: int) -> np.random.Generator:
    """The documented generator of a block of 256 steps."""
    key = np.random.SeedSequence(SEED).generate_state(2, np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, block, number, stream]))


@pytest.mark.parametrize("air", AIRS)
@pytest.mark.parametrize("law", LAWS)
def test_equals_a_loop_over_numbers_to_the_last_bit(law: str, air: str) -> None:
    """From the definition alone: streams 4, 5, 6; a link has the number receiver * 2^32 + sender, from 0."""
    setup = experiment(law, air)
    trajectory, model, noise = simulate(setup), build_step_model(setup), setup.noise
    heard_of = {(g, i): [j for j in range(4) if j != i and model.nominal[g, i, j]] for g in (0, 1) for i in range(4)}
    drawn: dict[tuple[int, int, int], Any] = {}

    def normal(stream: int, number: int, k: int) -> list[float]:
        block = k // BLOCK
        if (stream, number, block) not in drawn:
            drawn[stream, number, block] = philox(stream, number, block).standard_normal((BLOCK, 2))
        return drawn[stream, number, block][k % BLOCK].tolist()

    @cache
    def uniform(i: int, j: int, block: int) -> list[float]:
        return philox(LOSS, i * 2**32 + j, block).random(BLOCK).tolist()

    def lost(i: int, j: int, k: int) -> bool:
        return uniform(i, j, k // BLOCK)[k % BLOCK] < noise.loss.default

    x = trajectory.states[0].tolist()
    for k, g in enumerate(trajectory.modes.tolist()):
        published = [
            [x[i][r] + noise.broadcast * normal(BROADCAST, i, k)[r] if noise.broadcast else x[i][r] for r in (0, 1)]
            for i in range(4)
        ]
        assert published == (trajectory.states if trajectory.published is None else trajectory.published)[k].tolist()
        process = [normal(3, i, k) for i in range(4)]
        following = []
        for i in range(4):
            gone = {j: lost(i, j, k) for j in heard_of[g, i]}
            if trajectory.lost is not None:
                logged = trajectory.lost[k, i].tolist()
                assert logged[: len(gone)] == list(gone.values())
                assert not any(logged[len(gone) :])
            row = []
            for r in (0, 1):
                total = None
                for j in sorted([i, *gone]):
                    value = published[j][r]
                    if noise.link and j != i:
                        value += noise.link * normal(LINK, i * 2**32 + j, k)[r]
                    term = float(model.nominal[g, i, j]) * (x[i][r] if j == i or gone[j] else value)
                    total = term if total is None else total + term
                gain = float(model.noise_gain[g, i, i])
                drive = (gain * process[i][r] if gain else 0.0) + float(model.offsets[g, i])
                row.append(total + drive)
            following.append(row)
        x = following
        assert x == trajectory.states[k + 1].tolist(), k
    assert (trajectory.published is None) == (not noise.broadcast)
    assert (trajectory.lost is None) == (not noise.loss.any)


@pytest.mark.parametrize("resumed", [0, 100, 256, 290])
@pytest.mark.parametrize("law", ["consensus", "discrete"])
def test_agents_alone_equal_the_whole(law: str, resumed: int) -> None:
    """Also those that go on from some step."""
    setup = experiment(law, "all")
    trajectory, model = simulate(setup), build_step_model(setup)
    assert trajectory.published is not None
    assert trajectory.lost is not None
    agents = [agent_law(trajectory.record, model, i) for i in range(4)]
    for i, agent in enumerate(agents):
        if resumed:
            agent.resume(resumed, trajectory.states[resumed, i].tobytes())
    for k, g in list(enumerate(trajectory.modes.tolist()))[resumed:]:
        sent = trajectory.published[k]
        for i, agent in enumerate(agents):
            assert agent.published(k, agent.state) == sent[i].tobytes()
            neighbours = agent.neighbours(g)
            assert agent.advance(g, [sent[j].tobytes() for j in neighbours]) == trajectory.states[k + 1, i].tobytes()
            lost = trajectory.lost[k, i, : len(neighbours)]
            assert agent.heard == (tuple(LOST if gone else k for gone in lost) if lost.any() else ())


def same_air(one: Run, other: Run, agents: int) -> None:
    assert one.published is not None
    assert other.published is not None
    assert one.lost is not None
    assert other.lost is not None
    noise, others = one.published - one.states, other.published - other.states
    np.testing.assert_allclose(noise[:, :agents], others[:, :agents], atol=1e-12)


def test_the_air_depends_on_nothing_else() -> None:
    """Other replicas, weights, process noise, another agent: the same messages are lost, in the same steps."""
    base = {"name": "base", "graphs": {"a": {"path": [1, 2, 3]}, "b": {"path": [1, 2, 3]}}}
    base |= {"switching": {"generator": [[-1.0, 1.0], [1.0, -1.0]]}, "noise": AIRS["all"]}
    base["run"] = {"duration": 20, "seed": SEED, "start": "zero"}
    one = simulate(Experiment.parse(base))
    heavy = {"a": {"edges": [[1, 2, 2.0], [2, 3]]}, "b": {"edges": [[1, 2], [2, 3, 3.0]]}}
    four = {"a": {"path": [1, 2, 3, 4]}, "b": {"path": [1, 2, 3, 4]}}
    for changes in ({"graphs": heavy}, {"noise": AIRS["all"] | {"process": 0.1}}, {"graphs": four}):
        other = simulate(Experiment.parse(base | changes))
        same_air(one, other, 3)
        assert one.lost is not None
        assert other.lost is not None
        assert np.array_equal(one.lost[:, :2], other.lost[:, :2])
    many = simulate(Experiment.parse(base | {"run": base["run"] | {"replicas": 7}}))
    assert many.lost is not None
    assert np.array_equal(one.lost, many.lost)


@pytest.mark.parametrize("air", ["loss", "all"])
@pytest.mark.parametrize("law", LAWS)
def test_mean_square_error_is_the_predicted_one(law: str, air: str) -> None:
    """25 independent seeds, 50 replicas, thirty steps after a stationary start.

    z of the mean over seeds (replicas share lost messages), p > 4.2e-5 by Student's t with 24 degrees of freedom, for 4
    agents, 5 laws, 2 airs: a right program fails with probability about 2e-3. The replicas make up for the few seeds:
    an error that is wrong by a third fails.
    """
    dt = 1.0 if LAWS[law].get("time") == "discrete" else 0.2
    setup = experiment(law, air, replicas=50, dt=dt, duration=30 * dt)
    (steady,) = [errors for errors in (predict(setup).to_json().get(key) for key in ("emulated", "discrete")) if errors]
    means = []
    for seed in range(25):
        states = simulate(setup.with_run(seed=seed)).states[-1]
        deviation = states - (states.mean(axis=0) if setup.problem == "consensus" else setup.reference)
        means.append((deviation**2).mean(axis=1))
    spread = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    z = (np.mean(means, axis=0) - steady["node_errors"]) / np.where(spread > 0, spread, 1.0)
    assert 2 * scipy.stats.t.sf(np.abs(z).max(), len(means) - 1) > 4.2e-5
