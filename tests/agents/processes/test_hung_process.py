"""Processes that wait, run, sleep, are stopped, or have gone: only the first has hung."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from msg_agents.run.lifeline import LONGEST_LOOK, HungDetector
from started_processes import started_processes
from waiting import state_of, wait_for

from msg_agents.run import lifeline

BLOCKED = "import threading; lock = threading.Lock(); lock.acquire(); print(flush=True); lock.acquire()"
HELPED = (
    "import threading, time; lock = threading.Lock(); lock.acquire()\n"
    "def help():\n    while True: time.sleep(0.01)\n"
    "threading.Thread(target=help, daemon=True).start(); print(flush=True); lock.acquire()"
)
SLEEPING = "import time; print(flush=True)\nwhile True: time.sleep(0.02)"
RUNNING = "print(flush=True)\nwhile True: pass"
HUNG = 0.5  # s

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="this machine: no /proc")


@pytest.fixture
def start() -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    def start(code: str) -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "\n"
        return process

    with started_processes() as processes:
        yield start


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifeline, "HUNG", HUNG)


def looks(detector: HungDetector, seconds: float) -> bool:
    """Whether it is found to have hung within so many seconds."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if detector.update():
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("code", [BLOCKED, HELPED], ids=["alone", "another thread runs"])
def test_a_main_thread_that_waits_for_ever(start: Callable[[str], subprocess.Popen[str]], code: str) -> None:
    assert looks(HungDetector(start(code).pid), 30.0)


@pytest.mark.parametrize("code", [SLEEPING, RUNNING], ids=["sleeping", "running"])
def test_a_main_thread_that_runs(start: Callable[[str], subprocess.Popen[str]], code: str) -> None:
    assert not looks(HungDetector(start(code).pid), 2.5 * HUNG)


def test_stopped_and_gone(start: Callable[[str], subprocess.Popen[str]]) -> None:
    process = start(BLOCKED)
    process.send_signal(signal.SIGSTOP)
    detector = HungDetector(process.pid)
    assert not looks(detector, 2.5 * HUNG)
    process.kill()
    process.wait()
    assert not looks(detector, 1.5 * HUNG)


def test_neither_a_sleep_of_ours_nor_a_clock_that_is_set_back_counts(
    start: Callable[[str], subprocess.Popen[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifeline, "HUNG", 60.0)
    clock = SimpleNamespace(now=100.0, wall=1e9)
    times = SimpleNamespace(monotonic=lambda: clock.now, time=lambda: clock.wall)
    monkeypatch.setattr(lifeline, "time", times)
    process = start(BLOCKED)
    wait_for(lambda: state_of(process.pid) == "S")  # on a busy machine it may still run
    detector = HungDetector(process.pid)

    def passes(seconds: float, wall: float | None = None) -> str | None:
        clock.now, clock.wall = clock.now + seconds, clock.wall + (seconds if wall is None else wall)
        return detector.update()

    assert not any(passes(1.0) for _ in range(50))
    assert not passes(3600.0)  # with the machine, or stopped
    assert 50.0 + LONGEST_LOOK < 60.0
    assert not passes(1.0, wall=-100.0)
    assert not any(passes(1.0) for _ in range(98))
    assert any(passes(1.0) for _ in range(62))
