"""Events on the time axis: of the network, and of what the bag shows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from msg_analysis.common import arrays
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Completeness, Run
from msg_analysis.report import run_plots as events_module
from msg_analysis.report.run_plots import run_events, trajectory_plots
from msg_analysis.twin.simulate import simulate

PERIOD = 50_000_000  # ns of simulated time


def _run(**run: object) -> Run:
    document = {
        "name": "timed",
        "graphs": {"line": {"path": [1, 2, 3]}},
        "run": {"dt": 0.05, "duration": 10, "replicas": 2, "start": "zero"} | run,
    }
    return simulate(Experiment.parse(document))


@pytest.mark.parametrize("block", [6, 10**6])  # numbers that are looked at together
def test_late_steps(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "BLOCK_NUMBERS", block)
    trajectory = _run(pace="realtime", speed=5)
    assert trajectory.made is not None
    assert run_events(trajectory) == ([], 0)
    made = trajectory.made.copy()
    made[20:30, 1] += 2 * PERIOD
    made[33, 1] += 2 * PERIOD  # near: the same event
    made[60, 1] += 2 * PERIOD
    made[25, 2] += 2 * PERIOD
    made[100, 0] += PERIOD // 2  # not late
    found, more = run_events(dataclasses.replace(trajectory, made=made))
    assert more == 0
    assert [(one.kind, one.first, one.last, one.words) for one in found] == [
        ("late", 20, 33, "agent 2: late by more than a period in 11 steps"),
        ("late", 25, 25, "agent 3: late by more than a period in 1 step"),
        ("late", 60, 60, "agent 2: late by more than a period in 1 step"),
    ]


def test_missing_states_and_the_network() -> None:
    trajectory = _run()
    trajectory.states[7:10, 2] = np.nan
    trajectory = dataclasses.replace(trajectory, completeness=Completeness(expected=603, received=600, missing=3))
    reported = [
        {"kind": "back", "step": 50, "node": "agent_1", "words": "agent_1: back"},
        {"kind": "killed", "step": 40, "node": "agent_1", "words": "agent_1: killed"},
        {"kind": "unheard-of", "step": 1, "node": "x", "words": "x"},
    ]
    found, _ = run_events(trajectory, reported)
    assert [(one.kind, one.first, one.last) for one in found] == [
        ("missing", 7, 9),
        ("killed", 40, 40),
        ("back", 50, 50),
    ]
    plots, _ = trajectory_plots(trajectory, None, found)
    assert plots["events"].select_one({"name": "events"}).data["lane"] == [2, 0, 1]
    assert "events" not in trajectory_plots(trajectory, None)[0]


def test_not_more_than_can_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_module, "MOST_EVENTS", 2)
    trajectory = _run(pace="realtime", speed=5)
    assert trajectory.made is not None
    made = trajectory.made.copy()
    for first, length in ((10, 1), (30, 4), (60, 2), (90, 1)):
        made[first : first + length, 0] += 2 * PERIOD
    found, more = run_events(dataclasses.replace(trajectory, made=made))
    assert [one.first for one in found] == [30, 60]
    assert more == 2
