"""Verdicts of runs whose sequence of graphs is given: there is no chain to test, and all else is as ever."""

import dataclasses
import random
from typing import Any

import numpy as np
import pytest
from p_values import assert_covered

from experiments import changed, claimed, compare
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.simulate import simulate

MESSAGES: dict[str, dict[str, Any]] = {
    "plain": {},
    "air": {"noise": {"broadcast": 0.5, "link": 0.4, "loss": 0.2}},
    "late": {"noise": {"delay": 2, "link": 0.3}},
    "held": {"noise": {"loss": 0.3, "on_loss": "hold"}},
    "tracking": {"problem": "tracking", "leaders": {"agents": [1], "gain": 0.8, "reference": 3.0}},
    "real time": {"run": {"pace": "realtime"}},
    "real time, air": {"noise": {"link": 0.4, "loss": 0.2}, "run": {"pace": "realtime"}},
}


def scheduled(**changes: Any) -> Experiment:
    """Five agents and thirty random graphs, which no chain would make."""
    rng, agents = random.Random(7), range(1, 6)
    graphs = {"ring": {"cycle": [*agents]}}
    for number in range(29):
        arcs = [[a, b, rng.choice([0.3, 1.0])] for a in agents for b in agents if a != b and rng.random() < 0.3]
        graphs[f"g{number}"] = {"arcs": arcs or [[1, 2]]}
    times = np.cumsum([rng.choice([0.1, 0.3, 1.0, 3.0]) for _ in range(60)]).round(1).tolist()
    schedule = [[0.0, "ring"], *([time, rng.choice(list(graphs))] for time in times)]
    run = {"dt": 0.1, "duration": 25, "replicas": 4} | changes.pop("run", {})
    return Experiment.parse(
        {"name": "net", "graphs": graphs, "switching": {"schedule": schedule}, "run": run, **changes}
    )


@pytest.mark.parametrize("messages", MESSAGES)
def test_correct_runs(messages: str) -> None:
    law = scheduled(**MESSAGES[messages])
    found = [compare(simulate(law.with_run(seed=seed))) for seed in range(10)]
    assert_covered(found)
    assert all(one.switching is None for one in found)


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_faults_are_named(pace: str) -> None:
    law = scheduled(run={"pace": pace, "seed": 1})
    wrong = compare(claimed(simulate(changed(law, noise={"process": [1.0, 1.0, 1.5, 1.0, 1.0]})), law))
    assert (wrong.verdict, wrong.causes[0].kind, wrong.causes[0].agent) == ("disagrees", "noise", 3)


def test_another_sequence_is_named() -> None:
    run = simulate(scheduled())
    modes = run.modes.copy()
    modes[123] = 4
    found = compare(dataclasses.replace(run, modes=modes))
    names = [graph.name for graph in run.experiment.graph_list]
    assert found.verdict == "disagrees"
    words = f"graph {names[4]} was active in step 123, where the schedule has {names[run.modes[123]]}"
    assert words in [cause.words for cause in found.causes]
