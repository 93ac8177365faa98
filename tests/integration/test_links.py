"""Networks of processes with all that can happen to messages, in both paces: complete, and equal to the twin."""

import os
import random
import re
from itertools import product
from typing import Any

import numpy as np
import pytest
from networks import assert_equal_to_twin

from msg_analysis.bags.reading import read_bag
from msg_analysis.model.run import Run
from msg_analysis.twin.check import check

LOCKSTEP: dict[str, Any] = {"duration": 15, "replicas": 4}  # 300 steps: more than one block of noise
REALTIME: dict[str, Any] = {"pace": "realtime", "speed": 5, "dt": 0.05, "duration": 20}  # 100 steps a second for 4 s
UNDISTURBED = REALTIME | {"duration": 7.5}  # 150 steps, where nobody is killed in the middle
BY_LINK = {"default": 0.1, "edges": [[2, 3, 0.7]], "arcs": [[1, 2, 0.4]]}
MESSAGES: dict[str, dict[str, Any]] = {
    "plain": {},
    "own": {"broadcast": 0.3, "link": 0.2, "loss": 0.3},
    "whole": {"loss": 0.4, "whole_link": True},
    "hold": {"broadcast": 0.3, "link": 0.2, "loss": 0.4, "on_loss": "hold"},
    "late": {"broadcast": 0.3, "delay": 2},
    "bursts": {"link": 0.2, "loss": 0.4, "burst": 12},
    "all": {"broadcast": 0.3, "link": 0.2, "delay": 3, "loss": BY_LINK, "burst": 20, "on_loss": "hold"},
}
LAWS: dict[str, dict[str, Any]] = {
    "consensus": {},
    "leaders": {"problem": "tracking", "leaders": {"agents": [1, 4], "gain": 0.7, "reference": 2.0}},
    "grounded": {"problem": "tracking", "leaders": {"agents": [2], "gain": "inf", "reference": 1.0}},
    "metropolis": {"protocol": {"name": "metropolis", "laziness": 0.3}},
    "saturated": {"protocol": {"name": "saturated"}},
    "integral_action": {"protocol": {"name": "integral_action"}},
    "schedule": {"switching": {"schedule": [[0, "line"], [0.35, "ring"], [2, "line"]], "end": 4, "repeat": True}},
    "sojourns": {
        "switching": {"rates": {"line": {"ring": 1.0}, "ring": {"line": 1.0}}, "sojourn": {"line": {"shape": 3}}}
    },
    "activation": {"graphs": {"ring": {"cycle": [1, 2, 3, 4, 5]}}, "switching": {}, "noise": {"activation": 0.7}},
    "links": {
        "graphs": {"mesh": {"edges": [[1, 2], [2, 3], [3, 4], [4, 5], [1, 5], [2, 4, 0.5]]}},
        "switching": {"links": {"up": 2.0, "down": {"default": 0.5, "edges": [[3, 4, 1e-6]]}}},
    },
}
PROCESSES = ("one_per_agent", 2, 1)
Cells = list[tuple[str, str, int | str]]  # law, messages, processes


def cells(selected: Cells) -> Cells:
    """The selected combinations of laws and messages; all of them in ``make stress``."""
    return [(law, messages, 2) for law, messages in product(LAWS, MESSAGES)] if "STRESS" in os.environ else selected


def changes(law: str, messages: str, run: dict[str, Any]) -> dict[str, Any]:
    start = {} if law in ("consensus", "leaders", "grounded", "metropolis") else {"start": [1.0, -1.0, 2.0, 0.0, 3.0]}
    noise = {"process": 1.0, **LAWS[law].get("noise", {}), **MESSAGES[messages]}
    return {**LAWS[law], "noise": noise, "run": {**run, **start}}


def assert_equal(trajectory: Run) -> None:
    """Complete, and what the law and the seed give, to the last bit."""
    assert_equal_to_twin(trajectory)
    assert trajectory.completeness.refused == {}


@pytest.mark.parametrize(
    ("law", "messages", "processes"),
    cells(
        [
            ("consensus", "all", "one_per_agent"),
            ("leaders", "bursts", 2),
            ("grounded", "hold", 2),
            ("metropolis", "late", 2),
            ("integral_action", "all", 2),
            ("schedule", "whole", 2),
            ("links", "all", 2),
            ("activation", "all", 2),
        ]
    ),
)
def test_lockstep(network: Any, law: str, messages: str, processes: Any) -> None:
    result = network.run(network.experiment(**changes(law, messages, LOCKSTEP | {"processes": processes})))
    assert_equal(result.trajectory)


@pytest.mark.parametrize(
    ("law", "messages", "processes"),
    cells(
        [
            ("consensus", "own", 2),
            ("leaders", "hold", 2),
            ("grounded", "all", 2),
            ("saturated", "plain", 2),
            ("integral_action", "all", "one_per_agent"),
            ("schedule", "late", 2),
            ("links", "own", 2),
            ("activation", "own", 2),
            ("sojourns", "plain", 2),
        ]
    ),
)
def test_real_time(network: Any, law: str, messages: str, processes: Any) -> None:
    """What was used is what the rules allow: nothing that was lost, and nothing newer than the delay."""
    result = network.run(network.experiment(**changes(law, messages, UNDISTURBED | {"processes": processes})))
    assert_equal(result.trajectory)
    trajectory = result.trajectory
    assert (trajectory.used >= 0).any()
    noise = trajectory.record.experiment.noise
    silent = trajectory.used[100:, 3, 0] < 0  # agent 4 hears agent 3 in every graph
    assert silent.any() == bool(noise.loss.any and not noise.holds)


def test_killed_agents_hold_again_what_they_held(network: Any) -> None:
    """Bursts of 200 messages: an agent that comes back needs values from long before it was killed."""
    # Of four processes, one of a single agent and the one of two agents are killed.
    held = MESSAGES["all"] | {"delay": 2, "loss": 0.5, "burst": 200}
    run = {"duration": 150, "replicas": 16, "processes": 4}
    file = network.file(noise={"process": 1.0, **held}, run=run)

    def victims() -> list[Any]:
        found = [process for process in network.processes("agent") if process.agent in (2, 4)]
        return found if len(found) == 2 else []

    trajectory = network.killed_and_back(network.record(file, "--restarts", "4", "--json"), victims)
    assert_equal(trajectory)
    ages = np.arange(len(trajectory.used))[:, None, None] - trajectory.used
    assert ages[trajectory.used >= 0].max() > 200


def test_a_value_that_was_held_for_too_long(network: Any) -> None:
    """Of links that are nearly always silent: nobody has the values any more that a killed agent was holding."""
    held = {"loss": 0.5, "burst": 1e6, "on_loss": "hold"}
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    run_of_three = {"duration": 10_000, "start": "zero", "processes": 2}
    file = network.file(graphs=graphs, noise={"process": 1.0, **held}, run=run_of_three)
    run = network.record(file, "--restarts", "2")
    network.wait_for(lambda: network.recorded_bytes() > 900_000, 120, "7,000 steps, of which 6,000 are kept")
    next(one for one in network.processes("agent") if one.agent == 2).kill()
    _, stderr = network.ended(run, 3)
    words = r"failed: agents_2_to_3: .*agent_\d: cannot come back at step \d+: it held a value of step \d+, and agents "
    assert re.search(words + r"keep \d+ states: lower noise\.delay, noise\.burst", stderr), stderr


def test_any_of_them_with_kills(network: Any, repetition: int, rng: random.Random) -> None:
    """One of all combinations, with an agent killed in every other repetition."""
    law, messages, pace = rng.choice(list(LAWS)), rng.choice(list(MESSAGES)), rng.choice([LOCKSTEP, REALTIME])
    longer = pace | {"processes": rng.choice(PROCESSES), "replicas": 8}
    if pace is LOCKSTEP:
        longer["duration"] = 200
    print(law, messages, longer)
    file = network.file(**changes(law, messages, longer))
    run = network.record(file, "--restarts", "3", "--json")

    def victim() -> list[Any]:
        there = network.processes("agent")
        return [rng.choice(there)] if there else []

    if repetition % 2 == 0:
        assert_equal_but_for_restarts(network.killed_and_back(run, victim))
        return
    assert_equal(read_bag(network.result(run)["bag"]))


def assert_equal_but_for_restarts(trajectory: Run) -> None:
    """As above; in real time a state that was sent again may have come twice."""
    assert trajectory.completeness.complete
    assert check(trajectory).difference is None
