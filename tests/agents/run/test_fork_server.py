"""Processes forked from one that has imported everything: real ones, with the commands of the command line."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import record_of_two
from waiting import participants, wait_for

pytest.importorskip("rclpy")

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment, require_middleware
from msg_agents.run.fork_server import (
    LONGEST,
    LONGEST_TITLE,
    MOST_DESCRIPTORS,
    ForkedProcess,
    ForkServer,
    NodeStart,
    _messages,
)
from msg_analysis.common.resources import available_cores
from msg_analysis.errors import InputError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="this machine: not Linux")


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with free_domain() as number:
        yield number


@pytest.fixture
def server(tmp_path: Path, domain: int) -> Iterator[ForkServer]:
    with ForkServer(node_environment(domain), tmp_path / "server.log") as server:
        yield server
    assert not (tmp_path / "server.log").exists()  # it had nothing to say


@pytest.fixture
def waiting(tmp_path: Path) -> list[str]:
    """Arguments of an agent that waits for the other one until it is told to end."""
    return ["agent", str(record_of_two(tmp_path)), "--agent", "1"]


def start(server: ForkServer, log: Path, *arguments: str, core: int | None = None, **descriptors: int) -> ForkedProcess:
    with log.open("ab") as output:
        options = {f"--{name}": number for name, number in descriptors.items()}
        (process,) = server.fork_nodes([NodeStart(arguments, options, output.fileno(), core)])
        return process


def title(process: ForkedProcess) -> Sequence[str]:
    """What ``ps`` shows of a process."""
    return Path(f"/proc/{process.pid}/cmdline").read_text().rstrip("\0 ").split()


def status(process: ForkedProcess, key: str) -> str:
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next(line.split(":")[1].strip() for line in lines if line.startswith(f"{key}:"))


def test_what_a_command_prints_and_how_it_ends(server: ForkServer, tmp_path: Path) -> None:
    """Two exit codes at the same time, each from the right process."""
    good, bad = tmp_path / "good.log", tmp_path / "bad.log"
    processes = start(server, good, "agent", "--help"), start(server, bad, "agent", "nothing", "--agent", "1")
    assert [process.wait() for process in processes] == [0, 2]
    assert [process.poll() for process in processes] == [0, 2]
    assert good.read_text().startswith("Usage: msg-agents agent [OPTIONS] RUN_RECORD")
    assert bad.read_text().startswith("error: nothing: cannot be read")
    processes[0].send_signal(signal.SIGKILL)  # has ended: nothing happens


def test_a_forked_process_is_like_any_child(
    server: ForkServer, tmp_path: Path, waiting: list[str], domain: int
) -> None:
    core = available_cores()[-1]
    process = start(server, tmp_path / "log", *waiting, core=core)
    wait_for(lambda: participants(domain))  # its node is up
    assert title(process) == ["msg-agents", *waiting]
    assert f"ROS_DOMAIN_ID={domain}".encode() in Path(f"/proc/{process.pid}/environ").read_bytes().split(b"\0")
    assert status(process, "PPid") == str(os.getpid())
    assert status(process, "Cpus_allowed_list") == str(core)
    assert os.getsid(process.pid) == process.pid  # Ctrl-C on our terminal does not reach it
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait() == 3
    assert "Traceback" not in (tmp_path / "log").read_text()


def test_it_ends_when_its_lifeline_closes(server: ForkServer, tmp_path: Path, waiting: list[str], domain: int) -> None:
    reading, writing = os.pipe()
    process = start(server, tmp_path / "log", *waiting, lifeline=reading)
    os.close(reading)
    wait_for(lambda: participants(domain))
    assert process.poll() is None
    os.close(writing)
    assert process.wait() == 3


def test_a_command_of_any_length(server: ForkServer, tmp_path: Path, waiting: list[str], domain: int) -> None:
    """A process of many agents: its node starts, although ROS names a log file by what ``ps`` shows."""
    command, file, *rest = waiting
    foreign = Path(file).rename(tmp_path / f"{'ж' * 100}.json")
    process = start(server, tmp_path / "log", command, str(foreign), *rest, "--discovery-timeout", "60".zfill(3000))
    wait_for(lambda: participants(domain))
    assert LONGEST_TITLE - 2 < len(" ".join(title(process)).encode()) <= LONGEST_TITLE
    process.send_signal(signal.SIGINT)
    assert process.wait() == 3


def test_processes_outlive_a_killed_fork_server(
    server: ForkServer, tmp_path: Path, waiting: list[str], domain: int
) -> None:
    """How they end is known all the same; no more can be forked."""
    process = start(server, tmp_path / "log", *waiting)
    wait_for(lambda: participants(domain))
    os.kill(server.pid, signal.SIGKILL)
    for _ in range(2):
        assert server.fork_nodes([NodeStart(["agent", "--help"], {}, 1, None)]) == []
    assert process.poll() is None
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.parametrize(("middleware", "usable"), [("rmw_fastrtps_cpp", True), ("rmw_none_cpp", False)])
def test_the_middleware_is_tried(tmp_path: Path, domain: int, middleware: str, usable: bool) -> None:
    """In a forked process; where that cannot use it, the error is that of a process which has imported nothing."""
    environment = node_environment(domain) | {"RMW_IMPLEMENTATION": middleware}
    with ForkServer(environment, tmp_path / "server.log") as server:
        assert server.has_middleware() == usable
        with contextlib.nullcontext() if usable else pytest.raises(InputError, match="rmw_none_cpp: this ROS 2 "):
            require_middleware(environment, server.has_middleware)


def children() -> set[str]:
    """Numbers of the processes whose parent is this one."""
    return {pid for file in Path("/proc/self/task").glob("*/children") for pid in file.read_text().split()}


def test_a_middleware_that_hangs(tmp_path: Path, domain: int) -> None:
    """It cannot be used, and the process that tried it is ended."""
    (tmp_path / "sitecustomize.py").write_text("import rclpy, time\nrclpy.init = lambda: time.sleep(600)\n")
    with ForkServer(node_environment(domain) | {"PYTHONPATH": str(tmp_path)}, tmp_path / "server.log") as server:
        before = children()
        assert not server.has_middleware(timeout=1.0)
        assert children() <= before


def test_a_fork_server_that_cannot_import(tmp_path: Path) -> None:
    (tmp_path / "msg_agents.py").write_text("raise ImportError('broken')")
    log = tmp_path / "server.log"
    with ForkServer(os.environ | {"PYTHONPATH": str(tmp_path)}, log) as server:
        assert server.fork_nodes([NodeStart(["agent", "--help"], {}, 1, None)]) == []
        assert not server.has_middleware()
    assert "broken" in log.read_text()


WORK = """
import atexit, ctypes, os, sys, threading, time
def work():
    atexit.register(print, "handlers")
    threading.Thread(target=lambda: (time.sleep(0.2), print("threads"))).start()
    %s
"""
FORKED = """
from msg_agents.run.fork_server import run_and_end
if hasattr(ctypes.CDLL(None), "on_exit"):  # the C library of GNU
    ctypes.CDLL(None).on_exit(ctypes.CDLL(None).abort, None)  # as a library that crashes at its end
pid = os.fork()
if not pid:
    run_and_end(work)
os._exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


@pytest.mark.parametrize(
    ("statement", "code", "said"),
    [
        ("pass", 0, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("sys.exit(256 + 7)", 7, ""),
        ("sys.exit('why')", 1, "why\n"),
        ("raise OSError('why')", 1, "OSError: why\n"),
        ("sys.stdout = open('/dev/full', 'w'); print('lost')", 120, ""),
    ],
)
def test_a_forked_process_ends_as_python_does(statement: str, code: int, said: str) -> None:
    """After its threads and handlers, but without those of C libraries."""
    for end in ("work()", FORKED):
        process = subprocess.run([sys.executable, "-P", "-c", WORK % statement + end], capture_output=True, text=True)
        assert process.returncode == code
        assert process.stderr.endswith(said)
        assert process.stdout == ("" if code == 120 else "threads\nhandlers\n")


NODES = st.lists(
    st.tuples(st.integers(0, 9000), st.lists(st.integers(3, 400), unique=True, min_size=1, max_size=5)), max_size=80
)


@given(NODES)
def test_every_node_is_in_one_message_with_its_descriptors(sizes: list[tuple[int, list[int]]]) -> None:
    nodes = [
        NodeStart([str(i), "x" * size], {f"--{number}": number for number in others}, output, None)
        for i, (size, (output, *others)) in enumerate(sizes)
    ]
    received: list[tuple[Any, list[int]]] = []
    for message, descriptors in _messages(nodes):
        assert len(message) <= LONGEST
        assert len(descriptors) == len(set(descriptors)) <= MOST_DESCRIPTORS
        received += [(request, [descriptors[place] for place in places]) for request, places in json.loads(message)]
    assert received == [
        (
            {"arguments": node.arguments, "options": list(node.descriptors), "core": None},
            [node.output, *node.descriptors.values()],
        )
        for node in nodes
    ]


def test_few_messages() -> None:
    """A network of forty processes is one, and what they share is sent once."""
    nodes = [NodeStart(["agent", "run.json"], {"--lifeline": 6, "--status": 10 + i}, 5, None) for i in range(40)]
    ((_, descriptors),) = _messages(nodes)
    assert len(descriptors) == 42
