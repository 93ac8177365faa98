"""Starting, watching and ending processes; which of them have hung."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from networks import record_of_two
from waiting import gone, participants, state_of, wait_for

pytest.importorskip("rclpy")


from msg_agents.discovery.rtps import free_domain
from msg_agents.process_layout import ProcessSpec
from msg_agents.run.supervisor import ESCALATION, LONGEST_LOOK, Child, HungDetector, Supervisor
from msg_analysis.errors import ExitCode

STUBBORN = """
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: print(signal.Signals(number).name, flush=True))
print("ready", flush=True)
while True:
    time.sleep(60)
"""
OBEDIENT = """
import signal, sys
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
print("ready", flush=True)
signal.pause()
"""
# Takes the place of msg_agents in ``python -m msg_agents``: reports the steps that it reads from a file.
REPORTER = """
import json, os, sys
from pathlib import Path
sys.path.remove(os.environ["PYTHONPATH"])
from msg_agents.run.result import write_report
for line in open(sys.argv[2]):
    write_report(Path(sys.argv[sys.argv.index("--steps") + 1]), json.loads(line))
    print("written", flush=True)
"""
INCOMPLETE = OBEDIENT.replace("exit(0)", f"exit({ExitCode.INCOMPLETE:d})")
NAMES = ["agent_1", "agent_2", "recorder", "switcher"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Child]]:
    """Starts a child that is no node, waits until it is up, and sees to it that it goes."""
    children: list[Child] = []

    def start_child(code: str, name: str = "agent_1", *, number: int = 1, resumes: bool = False) -> Child:
        log = tmp_path / f"{name}.log"
        with log.open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                env={**os.environ, "PYTHONUNBUFFERED": "1"},  # as nodes have it: what is written first stands first
                stdout=output,
                stderr=output,
            )
        child = Child(ProcessSpec(name, (), resumes=resumes), process, log, number)
        children.append(child)
        wait_for(lambda: "ready\n" in log.read_text() or not child.running)
        return child

    yield start_child
    for child in children:
        child.process.kill()
        child.process.wait()


def supervised(directory: Path, *children: Child) -> Supervisor:
    """The same signals as usual, with less time to obey them; a process is late at once."""
    stages = [(number, 0.3 if number != signal.SIGKILL else 5.0) for number, _ in ESCALATION]
    assert [number for number, _ in stages] == [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]
    return Supervisor(directory, {}, list(children), escalation=stages, late=0.0)


def test_escalation(tmp_path: Path, start: Callable[..., Child]) -> None:
    child = start(STUBBORN)
    supervised(tmp_path, child).stop()
    assert child.log.read_text().split() == ["ready", "SIGINT", "SIGTERM"]
    assert child.failure == "killed by SIGKILL"
    assert not child.running


def test_leaving_the_context_ends_everybody_whatever_happened(tmp_path: Path, start: Callable[..., Child]) -> None:
    children = [start(STUBBORN, "agent_1"), start(OBEDIENT, "agent_2"), start(OBEDIENT, "recorder")]
    with pytest.raises(RuntimeError, match="the runner failed"), supervised(tmp_path, *children):
        raise RuntimeError("the runner failed")
    assert [child.process.poll() for child in children] == [-signal.SIGKILL, 0, 0]


def test_the_recorder_is_ended_last(tmp_path: Path, start: Callable[..., Child]) -> None:
    recorder = start(
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, lambda *_: (print(time.monotonic(), flush=True), sys.exit(0)))\n"
        "print('ready', flush=True)\nsignal.pause()",
        "recorder",
    )
    agent = start(
        "import atexit, signal, sys, time\n"
        "atexit.register(lambda: print(time.monotonic(), flush=True))\n"
        "signal.signal(signal.SIGINT, lambda *_: (time.sleep(0.1), sys.exit(0)))\n"
        "print('ready', flush=True)\nsignal.pause()"
    )
    supervised(tmp_path, recorder, agent).stop()
    told, ended = (float(child.last_line()) for child in (recorder, agent))
    assert ended < told


def test_causes_of_a_stall(tmp_path: Path, start: Callable[..., Child]) -> None:
    """In order: of the nodes' own reports, of stopped and silent processes, and where all is unknown, of the steps."""
    agent, recorder = start(OBEDIENT), start(OBEDIENT, "recorder")
    supervisor = supervised(tmp_path, agent, recorder)
    supervisor.last_step = 20
    assert supervisor.stall_causes(None) == "no report from agent_1, recorder"
    recorder.process.send_signal(signal.SIGSTOP)
    wait_for(lambda: recorder.stopped)
    stopped = f"stopped, and waited for: recorder (PID {recorder.process.pid})"
    assert supervisor.stall_causes(None) == f"{stopped}; no report from agent_1"
    recorder.process.send_signal(signal.SIGCONT)
    wait_for(lambda: not recorder.stopped)
    (tmp_path / "status").mkdir()
    for name in ("agent_1", "recorder"):
        (tmp_path / "status" / f"{name}.1.json").write_text("{}")
    supervisor.steps = [7, 5]
    assert supervisor.stall_causes(["Rome", "Ulm"]) == "slowest: agent Ulm, at step 5"
    supervisor.steps = [20, 20]
    assert supervisor.stall_causes(None) == "waiting for the end of agent_1, recorder"


def test_a_stopped_process_is_ended_too(tmp_path: Path, start: Callable[..., Child]) -> None:
    child = start(OBEDIENT)
    child.process.send_signal(signal.SIGSTOP)
    supervised(tmp_path, child).stop()
    assert child.failure == "killed by SIGKILL"


@pytest.mark.parametrize(
    ("code", "failure", "words", "number", "resumes"),
    [
        ("print('ready')", None, "ready", 1, False),
        ("import sys; print('ready'); sys.exit('error: no disk')", "exit code 1", "error: no disk", 1, True),
        ("import os; os.kill(os.getpid(), 9)", "killed by SIGKILL", "", 1, True),
        ("import os; os.kill(os.getpid(), 11)", "killed by SIGSEGV", "", 3, True),
        ("raise MemoryError", "exit code 1", "MemoryError", 2, False),  # its own fault, again
        ("import sys; sys.exit(2)", "exit code 2", "", 1, False),  # bad input
        ("import sys; sys.exit(3)", "exit code 3", "", 1, False),  # told to stop
    ],
)
def test_failures_and_which_are_worth_a_restart(
    tmp_path: Path, start: Callable[..., Child], code: str, failure: str | None, words: str, number: int, resumes: bool
) -> None:
    child, without = (start(code, name, number=number, resumes=name == "agent_1") for name in NAMES[:2])
    for each in (child, without):
        each.process.wait()
    supervisor = supervised(tmp_path, child)
    assert (child.failure, child.last_line()) == (failure, words)
    assert supervisor.failures == ([child] if failure else [])
    assert supervisor.running == []
    assert (child.resumes, without.resumes) == (resumes, False)


@pytest.mark.parametrize(
    ("killed", "over", "failed"),
    [
        (["agent_1"], True, []),
        (["switcher"], True, []),
        (["agent_1", "recorder"], True, ["recorder"]),
        (["switcher", "recorder"], False, ["recorder", "switcher"]),
    ],
    ids=["an agent", "the switcher", "an agent and the recorder", "the switcher and the recorder"],
)
def test_who_is_killed_after_the_end_has_not_failed(
    tmp_path: Path, start: Callable[..., Child], killed: list[str], over: bool, failed: list[str]
) -> None:
    """Except for the recorder, and only if the end is known: from the switcher, or from all the others."""
    children = [start("import os; os.kill(os.getpid(), 9)" if name in killed else "", name) for name in NAMES]
    for child in children:
        child.process.wait()
    supervisor = supervised(tmp_path, *children)
    assert supervisor.over == over
    assert [child.spec.name for child in supervisor.failures] == failed


def test_who_does_not_leave_after_the_end(tmp_path: Path, start: Callable[..., Child]) -> None:
    """Agents are ended; the recorder gets one signal, and is waited for."""
    agent, recorder, switcher = start(STUBBORN), start(INCOMPLETE, "recorder"), start("", "switcher")
    supervisor = supervised(tmp_path, agent, start("", "agent_2"), recorder, switcher)
    wait_for(lambda: supervisor.over)
    assert supervisor.dismiss_late() == ["agent_1", "recorder"]
    assert not agent.running
    assert supervisor.dismiss_late() == []
    recorder.process.wait()
    assert recorder.process.poll() == ExitCode.INCOMPLETE
    assert supervisor.failures == supervisor.awaited == []


def test_nobody_is_late_before_the_end(tmp_path: Path, start: Callable[..., Child]) -> None:
    agents, switcher = [start(OBEDIENT), start("")], start(OBEDIENT, "switcher")
    agents[1].process.wait()
    assert supervised(tmp_path, *agents, switcher).dismiss_late() == []
    assert supervised(tmp_path, *agents).dismiss_late() == []  # the switcher is on another host
    assert agents[0].running


def test_steps_that_the_switcher_reports(tmp_path: Path) -> None:
    """However many reports nobody has read: the newest counts, also when its process has gone."""
    (tmp_path / "msg_agents.py").write_text(REPORTER)
    orders = tmp_path / "orders"
    with Supervisor(tmp_path, os.environ | {"PYTHONPATH": str(tmp_path)}) as supervisor:
        supervisor.read_status()
        assert supervisor.steps == []
        reports = [[number, -1] * 500 for number in range(500)]  # more than any pipe holds
        assert sum(len(json.dumps(steps)) for steps in reports) > 2 << 20
        orders.write_text("".join(f"{json.dumps(steps)}\n" for steps in reports))
        supervisor.start([ProcessSpec("switcher", ("switcher", str(orders)))])
        (child,) = supervisor.children
        assert child.process.wait() == 0
        assert child.log.read_text().count("written") == len(reports)
        supervisor.read_status()
        assert supervisor.steps == reports[-1]
        (tmp_path / "steps.json").write_text("[1, ")  # no process of ours would leave this
        supervisor.read_status()
        assert supervisor.steps == reports[-1]


PARENT = """
import sys, time
from pathlib import Path
from msg_agents.process_layout import ProcessSpec
from msg_agents.environment import node_environment
from msg_agents.run.fork_server import ForkServer
from msg_agents.run.supervisor import Supervisor
directory = Path(sys.argv[1])
run_file = str(directory / "run.json")
plans = [
    ProcessSpec("recorder", ("recorder", run_file, "--out", str(directory / "bag"))),
    ProcessSpec("agent_1", ("agent", run_file, "--agent", "1")),
    ProcessSpec("switcher", ("switcher", run_file)),
]
environment = node_environment(int(sys.argv[2]))
with ForkServer(environment, directory / "server.log") as server:
    with Supervisor(directory, environment, fork_server=server if sys.argv[3] == "forked" else None) as supervisor:
        supervisor.start(plans)
        print(server.pid, *(child.process.pid for child in supervisor.children), flush=True)
        time.sleep(600)
"""


@pytest.mark.parametrize(("kind", "wait"), [("executed", False), ("executed", True), ("forked", True)])
def test_children_do_not_outlive_a_killed_parent(tmp_path: Path, kind: str, wait: bool) -> None:
    """Nor does the process that forks them. Killed while they start, or while they wait."""
    record_of_two(tmp_path)
    with free_domain() as domain:
        command = [sys.executable, "-P", "-c", PARENT, str(tmp_path), str(domain), kind]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
            pids = [int(word) for word in parent.stdout.readline().split()]
            assert len(pids) == 4
            if wait:
                wait_for(lambda: (tmp_path / "bag").exists() and participants(domain) == 3)
            parent.kill()
        try:
            wait_for(lambda: all(gone(pid) for pid in pids), 10.0)
        finally:
            for pid in pids:
                if not gone(pid):
                    os.kill(pid, signal.SIGKILL)


BLOCKED = "import threading; lock = threading.Lock(); lock.acquire(); print('ready'); lock.acquire()"
HELPED = (
    "import threading, time; lock = threading.Lock(); lock.acquire()\n"
    "def help():\n    while True: time.sleep(0.01)\n"
    "threading.Thread(target=help, daemon=True).start(); print('ready'); lock.acquire()"
)
SLEEPING = "import time; print('ready')\nwhile True: time.sleep(0.02)"
RUNNING = "print('ready')\nwhile True: pass"
HUNG = 0.5  # s


def looks(detector: HungDetector, seconds: float) -> bool:
    """Whether it is found to have hung within so many seconds."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if detector.update(HUNG):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("code", "hung"),
    [(BLOCKED, True), (HELPED, True), (SLEEPING, False), (RUNNING, False)],
    ids=["waits for ever", "and another thread runs", "sleeps", "runs"],
)
def test_main_threads(start: Callable[..., Child], code: str, hung: bool) -> None:
    assert looks(start(code).detector, 30.0 if hung else 2.5 * HUNG) == hung


def test_stopped_and_gone(start: Callable[..., Child]) -> None:
    process = start(BLOCKED).process
    process.send_signal(signal.SIGSTOP)
    detector = HungDetector(process.pid)
    assert not looks(detector, 2.5 * HUNG)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not looks(detector, 1.5 * HUNG)


def test_neither_a_sleep_of_ours_nor_a_clock_that_is_set_back_counts(start: Callable[..., Child]) -> None:
    clock = SimpleNamespace(now=100.0, wall=1e9)
    process = start(BLOCKED).process
    wait_for(lambda: state_of(process.pid) == "S")  # on a busy machine it may still run
    detector = HungDetector(process.pid, clock=lambda: clock.now, wall=lambda: clock.wall)

    def passes(seconds: float, wall: float | None = None) -> str | None:
        clock.now, clock.wall = clock.now + seconds, clock.wall + (seconds if wall is None else wall)
        return detector.update()

    assert not any(passes(1.0) for _ in range(50))
    assert not passes(3600.0)  # with the machine, or stopped
    assert 50.0 + LONGEST_LOOK < 60.0
    assert not passes(1.0, wall=-100.0)
    assert not any(passes(1.0) for _ in range(98))
    assert any(passes(1.0) for _ in range(62))
