"""Faults of processes that are no nodes: at their steps, and not later."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from waiting import state_of, wait_for

from msg_agents.doctor.networks.fault_injection import FaultInjection
from msg_agents.doctor.networks.fault_plan import Fault, FaultPlan
from msg_agents.terminal.interruption import Interruption

Processes = dict[str, subprocess.Popen[bytes]]


@pytest.fixture
def processes() -> Iterator[Processes]:
    """Of two agents and a recorder, which do nothing."""
    started = {name: subprocess.Popen(["sleep", "600"]) for name in ("agent_1", "agent_2", "recorder")}
    yield started
    for process in started.values():
        process.kill()
        process.wait()


def injection(processes: Processes, *faults: Fault) -> FaultInjection:
    made = FaultInjection(FaultPlan(faults, 3))
    made.started(processes)
    return made


def stopped(process: subprocess.Popen[bytes]) -> bool:
    return state_of(process.pid) == "T"


def test_a_kill_comes_when_all_agents_have_made_its_step(processes: Processes) -> None:
    late, early = Fault("agent_2", 7, 0.0), Fault("agent_1", 5, 0.0)
    made = injection(processes, early, late)
    made.look([])
    made.look([4, 9])
    assert made.delivered == []
    made.look([6, 9])
    assert made.delivered == [early]
    assert processes["agent_1"].wait() == -signal.SIGKILL
    made.look([7, 9])
    assert made.delivered == [early, late]
    assert processes["agent_2"].wait() == -signal.SIGKILL
    assert processes["recorder"].poll() is None


def test_a_fault_before_the_first_step(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", -1, 0.0))
    made.look([])
    assert processes["agent_1"].wait() == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: no /proc")
@pytest.mark.parametrize("ending", [False, True])
def test_a_stopped_process_goes_on(processes: Processes, ending: bool) -> None:
    """After its time, or as soon as the run is over."""
    made = injection(processes, Fault("recorder", 0, 0.0, stopped=600.0 if ending else 0.0))
    made.look([0, 0])
    wait_for(lambda: stopped(processes["recorder"]))
    if ending:
        made.look([1, 1])
        assert stopped(processes["recorder"])
        made.end()
    else:
        made.look([1, 1])
    wait_for(lambda: not stopped(processes["recorder"]))


def test_a_process_that_has_ended_meets_no_fault(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", 0, 0.0), Fault("agent_2", 0, 0.0, stopped=1.0))
    for name in ("agent_1", "agent_2"):
        processes[name].kill()
        processes[name].wait()
    made.look([3, 3])
    assert made.delivered == []


def test_the_process_of_a_restarted_node(processes: Processes) -> None:
    made = injection(processes, Fault("agent_1", 2, 0.0))
    processes["agent_1"].kill()
    processes["agent_1"].wait()
    made.started(processes | {"agent_1": processes["recorder"]})
    made.look([2, 2])
    assert processes["recorder"].wait() == -signal.SIGKILL


def test_a_run_that_stands_still_is_ended_once(processes: Processes) -> None:
    made = FaultInjection(FaultPlan((), 3), patience=0.0)
    made.started(processes)
    made.note("no step for 5 s: cause unknown")
    with Interruption() as interruption:
        made.look([2, 3])
        assert interruption.caught is None
        wait_for(lambda: made.look([2, 3]) or made.standstill)
        assert interruption.caught == signal.SIGINT
        interruption.caught = None
        made.look([2, 3])
        assert interruption.caught is None
    assert made.standstill == "ended after 0 s without a step: no step for 5 s: cause unknown"
