"""What is wrong with a run is found: planted in one of the offline twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_agents.doctor.networks.fault_plan import Fault, FaultPlan
from msg_agents.doctor.networks.outcome import Outcome, Verdict, exit_code, judge, summary, to_json
from msg_agents.running.run_result import RunResult
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.twin.simulate import simulate

KILL, STOP = Fault("agent_2", 10, 0.0), Fault("agent_1", 20, 0.0, stopped=1.0)
KILL_RECORDER = Fault("recorder", 10, 0.0)
KILLED = "agent_2: killed by SIGKILL after step 12, started again"
SALVAGED = "the bag was salvaged: 100 messages kept"
LAST = "last recorded step: agent 1: 40, agent 2: 41, agent 3: 40"


def simulated(seed: int) -> Trajectory:
    document = {
        "name": "small",
        "graphs": {"line": {"path": [1, 2, 3]}, "pair": {"path": [1, 2]}},
        "switching": {"rates": {"line": {"pair": 2.0}, "pair": {"line": 2.0}}},
        "run": {"duration": 5, "start": "zero", "seed": seed},
    }
    return simulate(ValidExperiment.parse(document))


@pytest.fixture(scope="module")
def twin() -> Trajectory:
    return simulated(0)


def run(trajectory: Trajectory, **changes: Any) -> RunResult:
    return RunResult(trajectory.record.experiment, None, trajectory=trajectory, **changes)


def plan(*faults: Fault, restarts: int = 3) -> FaultPlan:
    return FaultPlan(faults, restarts)


def test_equal(twin: Trajectory) -> None:
    assert judge(run(twin), plan()) == Verdict("equal", "303 states", 303)
    assert judge(run(twin, restarts=[KILLED]), plan(KILL, STOP)).status == "equal"


def one_bit(states: Any) -> None:
    states[57, 1, 0] = np.nextafter(states[57, 1, 0], np.inf)


def changed(twin: Trajectory, change: Callable[[Any], None]) -> Trajectory:
    states = twin.states.copy()
    change(states)
    return replace(twin, states=states)


def test_one_bit(twin: Trajectory) -> None:
    """In the last place of one number; whatever else has happened."""
    wrong = changed(twin, one_bit)
    for verdict in (
        judge(run(wrong), plan()),
        judge(run(wrong, failures=["recorder: killed by SIGKILL", SALVAGED]), plan(KILL_RECORDER)),
        judge(run(wrong), plan(), "ended after 60 s without a step"),
    ):
        assert verdict.status == "differs"
        assert verdict.text.startswith("agent 2 at step 57, replica 1: logged ")


def test_another_seed(twin: Trajectory) -> None:
    other = replace(simulated(1), record=twin.record)
    assert judge(run(other), plan(KILL)).status == "differs"


def test_missing_and_twice(twin: Trajectory) -> None:
    count = twin.completeness
    for found in (replace(count, missing=1), replace(count, missing_modes=1), replace(count, duplicates=1)):
        verdict = judge(run(replace(twin, completeness=found)), plan(KILL))
        assert verdict.status == "failed", found


@pytest.mark.parametrize(
    ("faults", "restarts", "failures"),
    [
        ([KILL_RECORDER], 3, ["recorder: killed by SIGKILL", SALVAGED, LAST]),
        ([KILL_RECORDER, STOP], 3, ["recorder: killed by SIGKILL", "nothing was recorded: the run ended before"]),
        ([KILL], 0, ["agent_2: killed by SIGKILL: a last word", LAST]),
        ([KILL] * 4, 3, ["agents_2_to_3: killed by SIGKILL. Not started again: all restarts are used up", LAST]),
    ],
)
def test_ended_by_its_faults(twin: Trajectory, faults: list[Fault], restarts: int, failures: list[str]) -> None:
    """But not without them, or if it could have gone on."""
    short = replace(twin, completeness=replace(twin.completeness, missing=200))
    ended = run(short, failures=failures)
    assert judge(ended, plan(*faults, restarts=restarts)) == Verdict("ended", failures[0], 303)
    assert judge(ended, plan(STOP, restarts=restarts)) == Verdict("failed", failures[0], 303)
    assert judge(ended, plan(KILL, restarts=1)).status == "failed"
    worse = run(short, failures=[*failures, "agent_1: exit code 1: MemoryError"])
    assert judge(worse, plan(*faults, restarts=restarts)).status == "failed"


def test_restarts_without_a_fault(twin: Trajectory) -> None:
    crash = "agent_2: exit code 1 (KeyError: 3), started again"
    for restarts, faults in (([crash], [KILL]), ([KILLED, crash], [KILL, KILL]), ([KILLED, KILLED], [KILL, STOP])):
        verdict = judge(run(twin, restarts=restarts), plan(*faults))
        assert verdict.status == "failed"
        assert verdict.text == f"restarted without a fault: {restarts[-1]}"


def test_a_standstill(twin: Trajectory) -> None:
    """Its bag was not read."""
    result = RunResult(twin.record.experiment, None, interrupted_by=2, failures=["stopped by Ctrl-C at step 3"])
    words = "ended after 60 s without a step"
    assert judge(result, plan(KILL), words) == Verdict("failed", words)


def outcome(seed: int, verdict: Verdict, *faults: Fault) -> Outcome:
    folder = None if verdict.status in ("equal", "ended") else Path(f"/runs/network_{seed}")
    return Outcome(seed, 3, 5, 2, 100, faults, [KILLED], [], verdict, 2.5, folder)


EQUAL = outcome(4, Verdict("equal", "303 states", 303), KILL, STOP, KILL)
ENDED = outcome(5, Verdict("ended", "recorder: killed by SIGKILL", 100), KILL_RECORDER)
DIFFERS = outcome(6, Verdict("differs", "agent 1 at step 3", 303))
FAILED = outcome(7, Verdict("failed", "5 states or graphs are missing"))


@pytest.mark.parametrize(
    ("outcomes", "code"),
    [
        ([EQUAL], 0),
        ([EQUAL, ENDED], 0),
        ([EQUAL, FAILED], 3),
        ([DIFFERS, ENDED], 1),
        ([FAILED, DIFFERS, FAILED], 1),
    ],
)
def test_exit_codes(outcomes: list[Outcome], code: int) -> None:
    assert exit_code(outcomes) == code
    assert to_json(outcomes)["good"] == (code == 0)


def test_in_words() -> None:
    assert summary([EQUAL]) == "1 network, 2 kills, 1 stop, 303 states compared: 1 equal to the twin to the last bit."
    assert summary([EQUAL, ENDED, DIFFERS, FAILED]) == (
        "4 networks, 3 kills, 1 stop, 706 states compared: 1 equal to the twin to the last bit; 1 ended by faults as "
        "documented, and equal until then; 1 different from the twin; 1 failed."
    )


def test_as_json() -> None:
    document = to_json([EQUAL, DIFFERS])
    assert [document[key] for key in ("good", "equal", "ended", "differs", "failed")] == [False, 1, 0, 1, 0]
    equal, differs = document["networks"]
    assert (equal["seed"], equal["status"], equal["compared"], equal["folder"]) == (4, "equal", 303, None)
    assert equal["faults"][1] == {"node": "agent_1", "step": 20, "wait": 0.0, "stopped": 1.0}
    assert (differs["folder"], differs["text"]) == ("/runs/network_6", "agent 1 at step 3")
