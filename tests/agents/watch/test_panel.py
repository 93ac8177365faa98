"""Snapshots of a run, its panel in the terminal, and what a page gets."""

import io
import re
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import networks
import numpy as np
import pytest
from rich.console import Console

from msg_agents.watch.panel import Display, gauge, panel_of, plain_line
from msg_agents.watch.snapshot import (
    HoldingPeriods,
    Snapshot,
    SnapshotSource,
    StepRates,
    run_description,
    snapshot_document,
)
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.online_errors import LiveEstimate, LiveReport
from msg_analysis.inference.online_steps import WINDOW
from msg_analysis.model.graph_path import HoldingPeriod
from msg_analysis.twin.simulate import simulate


def _experiment(agents: int = 5) -> Experiment:
    numbers = list(range(1, agents + 1))
    graphs = {"line": {"path": numbers}, "a ring [bold] of $$ a very long name": {"cycle": numbers}}
    return networks.experiment(agents, graphs=graphs, run={"duration": 400})


def _report(agents: int, *, judged: bool = True) -> LiveReport:
    error = 0.05 if judged else None
    nodes = [Estimate(1.0 + i / 50, 1.0, error, i / 2.5 if judged else None) for i in range(agents)]
    return LiveReport(0, 4000, 4001, 4001, Estimate(1.45, 1.41, 0.03, 1.33), nodes, None)


def _snapshot(agents: int, **changes: object) -> Snapshot:
    values: dict[str, object] = {
        "steps": [4000 + i % 7 for i in range(agents)],
        "rates": [500.0 + i for i in range(agents)],
        "rate": 500.0,
        "holding": HoldingPeriod(41, 1, 3990, 4010),
        "left": 61.2,
        "report": _report(agents),
    }
    return Snapshot(**(values | changes))


def _lines(snapshot: Snapshot, experiment: Experiment, width: int, height: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None)
    console.print(panel_of(snapshot, experiment, width=width, height=height))
    return console.file.getvalue().rstrip("\n").split("\n")


@pytest.mark.parametrize(("width", "height"), [(80, 24), (200, 60), (40, 12), (24, 8), (12, 4)])
@pytest.mark.parametrize("agents", [3, 5, 20, 100])
@pytest.mark.parametrize("judged", [True, False])
def test_fits(width: int, height: int, agents: int, judged: bool) -> None:
    lines = _lines(_snapshot(agents, report=_report(agents, judged=judged)), _experiment(agents), width, height)
    assert max(map(len, lines)) <= width
    assert len(lines) <= max(height, 9)  # of less, the terminal shows the beginning


def test_says_how_it_stands() -> None:
    text = "\n".join(_lines(_snapshot(5), _experiment(), 120, 24))
    for words in (
        "net: 5 agents, lockstep",
        "step 4000 of 8000  50 %  500 steps/s  1:02 left",
        "graph a ring [bold] of $$",
        "for 0.5 units of time, steps 3990 to 4011, after 41 jumps",
        "system error 1.45 ± 0.059 (95 %), predicted 1.41, z = +1.33",
    ):
        assert words in text
    assert re.search(r"\b5 +4004 +504 +1\.08 +0\.098 +1 +\+1\.6", text)
    assert "simulated time 200, errors of 4001 steps, 0 missing" in text


def test_a_watched_network_has_one_step_for_all() -> None:
    """Then no agent has a step of its own, in the panel and on the page; missing steps and refusals are told."""
    report = replace(_report(5), last=4099, first=1, refused={"not finite": 3})
    found = _snapshot(5, steps=[4000], rates=[500.0], report=report)
    text = "\n".join(_lines(found, _experiment(), 120, 24))
    assert "step 4000 of 8000  50 %  500 steps/s  1:02 left" in text
    assert "errors of 4001 steps since step 1, 98 missing, not finite: 3" in text
    assert re.search(r"│ +5 +1\.08 +0\.098 +1 +\+1\.6", text)
    assert snapshot_document(found)["steps"] == []
    many = "\n".join(_lines(_snapshot(100, steps=[4000], rates=[500.0]), _experiment(100), 80, 24))
    assert "100 agents at step 4000" in many


def test_many_agents_are_summed_up() -> None:
    text = "\n".join(_lines(_snapshot(100), _experiment(100), 80, 24))
    assert "100 agents at steps 4000 to 4006, 500 to 599 steps/s" in text
    assert "above: the agents with the largest |z|" in text
    assert re.search(r"│ +100 ", text)
    assert not re.search(r"│ +1 ", text)


def test_before_anything_is_known() -> None:
    experiment = _experiment()
    assert "starting" in "\n".join(_lines(Snapshot([]), experiment, 80, 24))
    assert "waiting for the first states" in "\n".join(_lines(Snapshot([-1] * 5), experiment, 80, 24))
    text = "\n".join(_lines(_snapshot(5, report=None, rates=[], left=None, note="why not"), experiment, 80, 24))
    assert "why not" in text
    assert "left" not in text
    assert plain_line(_snapshot(5), experiment) == (
        "step 4000 of 8000, 500 steps/s, graph a ring [bold] of $$ a very long name, 1:02 left"
    )


@pytest.mark.parametrize(
    ("estimate", "picture"),
    [
        (Estimate(1.0, 1.0, 0.1, 0.0), "├────◉────┤"),
        (Estimate(1.0, 1.5, 0.1, -5.0), "├─●─┤       ◆"),
        (Estimate(1.0, 0.5, 0.1, 5.0), "◆       ├─●─┤"),
    ],
)
def test_gauge(estimate: Estimate, picture: str) -> None:
    text = gauge(estimate, 20).plain.partition("  ●")[0]
    marks = [re.sub(" +", " ", re.sub("─+", "─", line.strip())) for line in (text, picture)]
    assert marks[0] == marks[1]
    assert gauge(Estimate(1.0), 20).plain == ""


def test_the_sojourns_are_those_of_the_run() -> None:
    """Beside the path of the offline twin."""
    experiment = _experiment()
    modes = simulate(experiment).modes
    path = HoldingPeriods(experiment)
    for step in range(0, 8000, 37):
        holding = path.at(step)
        assert holding.first_step <= step <= holding.last_step
        assert (modes[holding.first_step : holding.last_step + 1] == holding.mode).all()
    assert path.at(8000) is not None


def test_documents_for_the_page() -> None:
    experiment = _experiment()
    found = run_description(experiment)
    assert [graph["name"] for graph in found["graphs"]] == [graph.name for graph in experiment.graph_list]
    assert found["graphs"][0]["links"] == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert len(found["places"]) == 5
    found = snapshot_document(_snapshot(5))
    assert found["system"]["measured"] == 1.45
    assert found["holding"] == [42, 3990, 4010]
    assert SnapshotSource(experiment).snapshot([]).reached == -1


def test_the_speed_of_agents_that_step_in_bursts() -> None:
    """Two agents make 64 steps every 4 s, in turn: one of them has made none in the last 3 s."""
    clock = SimpleNamespace(now=0.0)
    rates = StepRates(lambda: clock.now)
    assert rates.rates() == ([], None)
    for tick in range(88):
        clock.now = 0.25 * tick
        rates.add([64 * (tick // 16), 64 * ((tick + 8) // 16)])
    assert rates.rates() == ([pytest.approx(64 / 3.25), 0.0], pytest.approx(64 / 3.25))


def test_a_run_that_ends_before_its_planned_end() -> None:
    """The steps are those that it has; what some agents did after its end does not count."""
    experiment = _experiment()
    snapshot = _snapshot(5, last=4000, holding=HoldingPeriod(41, 1, 3990, 4010), left=0.0)
    shown = _lines(snapshot, experiment, 120, 24)
    assert "step 4000 of 4000  100 %" in shown[1]
    assert "steps 3990 to the end" in shown[2]
    assert plain_line(snapshot, experiment).startswith("step 4000 of 4000, ")
    assert (snapshot_document(snapshot)["reached"], snapshot_document(snapshot)["last"]) == (4000, 4000)
    source = SnapshotSource(experiment)
    assert source.snapshot([4000] * 5).last is None
    source.ends_at(4002)
    found = source.snapshot([4003, 4002, 4002, 4004, 4002])
    assert (found.reached, found.last) == (4002, 4002)


def test_an_agent_that_goes_and_comes_back() -> None:
    """It is gone until its new process makes a step; the others are where they were."""
    clock = SimpleNamespace(now=100.0)
    source = SnapshotSource(_experiment(), lambda: clock.now)
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
    assert list(found.events) == [
        (5, "agent_2: killed by SIGKILL after step 5, started again"),
        (6, "agent 2 is back"),
    ]


def test_a_silent_agent_in_real_time_stops_nobody_else() -> None:
    """The run goes on where the others are, with a warning; in lockstep all wait, and none is named."""
    clock = SimpleNamespace(now=100.0)
    for pace, reached, silent in (("realtime", 90, {1}), ("lockstep", 50, set())):
        source = SnapshotSource(_experiment().with_run(pace=pace), lambda: clock.now)
        source.snapshot([50] * 5)
        clock.now += 2.0
        source.snapshot([90, 50, 90, 90, 90])
        clock.now += 0.1
        found = source.snapshot([90, 50, 90, 90, 90], pids={1: 77})
        assert (found.reached, found.silent) == (reached, silent)
        document = snapshot_document(found)
        assert document["errors_step"] is None  # there are no errors yet
        said = "agent 2 (PID 77) has made no step for 2.1 s; the other 4 are on time" if silent else None
        assert document["warning"] == said


def test_the_states_for_the_page_have_the_graphs_of_their_steps() -> None:
    ours = _experiment()
    trajectory = simulate(ours)
    estimate = LiveEstimate(trajectory.record)
    estimate.add_whole(np.arange(900), trajectory.modes[:900], trajectory.states[:900], trajectory.states[1:901])
    source = SnapshotSource(ours)
    trace = snapshot_document(source.snapshot([901] * 5, estimate.report()))["trace"]
    assert trace["steps"] == [*range(900 - WINDOW, 900)]
    assert trace["agents"] == pytest.approx(trajectory.states[900 - WINDOW : 900, :, 0].T, rel=1e-3)
    graph = {step: mode for mode, first, last in trace["path"] for step in range(first, last + 1)}
    assert [graph[step] for step in trace["steps"]] == trajectory.modes[900 - WINDOW : 900].tolist()


def test_states_are_formatted_when_there_are_new_ones() -> None:
    ours = _experiment()
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
    source = SnapshotSource(_experiment())
    for count in (1, 2, 3):
        found = source.snapshot([4] * 5, LiveReport(0, 3, 4, 3, Estimate(), [], None, {"undecodable": count}))
    assert [text for _, text in found.events] == ["messages are refused: undecodable (1 so far)"]


def test_a_page_that_is_not_ready_holds_up_nobody() -> None:
    """The network is watched while its description is being made; the end waits for that."""
    ready, seen = threading.Event(), []

    def begin(_: dict[str, Any]) -> None:
        ready.wait()
        seen.append("begin")

    web = SimpleNamespace(begin=begin, end=lambda *_: seen.append("end"))
    with Display(Console(), cast("Any", web), panel=False, transient=True) as display:
        assert display.begin(_experiment())
        assert seen == []
        ready.set()
    display.end({})
    assert seen == ["begin", "end"]
