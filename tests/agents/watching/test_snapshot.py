"""Snapshots of a run, and what a page gets of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from msg_agents.watch import snapshot
from msg_agents.watch.snapshot import SnapshotSource, snapshot_document
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.online_errors import LiveEstimate, LiveReport
from msg_analysis.inference.online_steps import WINDOW
from msg_analysis.twin.simulate import simulate


def experiment() -> Experiment:
    return Experiment.parse(
        {
            "name": "net",
            "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 0.05, "duration": 100, "seed": 7},
        }
    )


def test_an_agent_that_goes_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is gone until its new process makes a step; the others are where they were."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(snapshot, "time", SimpleNamespace(monotonic=lambda: clock.now))
    source = SnapshotSource(experiment())
    assert source.snapshot([]).events == ()
    source.snapshot([5, 5, 5, 5, 5])
    clock.now += 2
    source.happened("agent_2: killed by SIGKILL after step 5, started again")
    found = source.snapshot([6, 5, 6, 6, 6], ended=[1])
    assert (found.gone, found.ages) == ({1}, [0, 2, 0, 0, 0])
    found = source.snapshot([7, 5, 7, 7, 7])  # it has a process, and no step yet
    assert found.gone == {1}
    clock.now += 1
    found = source.snapshot([7, 6, 7, 7, 7])
    assert (found.gone, found.ages) == (set(), [1, 0, 1, 1, 1])
    assert [(event.step, event.text) for event in found.events] == [
        (5, "agent_2: killed by SIGKILL after step 5, started again"),
        (6, "agent 2 is back"),
    ]


def test_the_states_for_the_page_have_the_graphs_of_their_steps() -> None:
    ours = experiment()
    trajectory = simulate(ours)
    estimate = LiveEstimate(trajectory.record)
    estimate.add_whole(np.arange(900), trajectory.modes[:900], trajectory.states[:900], trajectory.states[1:901])
    source = SnapshotSource(ours)
    trace = snapshot_document(source.snapshot([901] * 5, estimate.report()))["trace"]
    assert trace["steps"] == [*range(900 - WINDOW, 900)]
    assert trace["agents"] == pytest.approx(trajectory.states[900 - WINDOW : 900, :, 0].T, rel=1e-3)
    graph = {step: mode for mode, first, last in trace["sojourns"] for step in range(first, last + 1)}
    assert [graph[step] for step in trace["steps"]] == trajectory.modes[900 - WINDOW : 900].tolist()


def test_states_are_formatted_when_there_are_new_ones() -> None:
    ours = experiment()
    trajectory = simulate(ours)
    estimate = LiveEstimate(trajectory.record)
    source, document = SnapshotSource(ours), None
    for first, last, new in ((0, 10, True), (10, 10, False), (10, 11, True), (11, 11, False)):
        step = slice(first, last)
        after = trajectory.states[first + 1 : last + 1]
        if new:
            estimate.add_whole(np.arange(first, last), trajectory.modes[step], trajectory.states[step], after)
        before, document = document, snapshot_document(source.snapshot([last] * 5, estimate.report()), document)
        assert document["trace"]["steps"] == [*range(last)]
        assert (before is None or document["trace"] is not before["trace"]) == new


def test_refused_messages_are_an_event_once_for_each_reason() -> None:
    source = SnapshotSource(experiment())
    for count in (1, 2, 3):
        found = source.snapshot([4] * 5, LiveReport(0, 3, 4, 3, Estimate(), [], None, {"undecodable": count}))
    assert [event.text for event in found.events] == ["messages are refused: undecodable (1 so far)"]
