"""Networks of real processes, and the means to see what became of each of them.

Every process that a test starts, however indirectly, carries the test's mark in its environment. So a test can find a
child of a child, and no test ends well while any process of it is left, or anything else that its networks made for
themselves only: shared memory, the folder of a run.
"""

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from left_processes import describe, last_line
from many_commands import MARK, ForkedCommand, ensure_running, start_program
from networks import assert_equal_to_twin, document, experiment
from started_processes import started_processes
from terminal import Terminal
from waiting import wait_for

pytest.importorskip("rclpy")

from msg_agents.discovery.rtps import free_domain
from msg_agents.run import fork_server
from msg_agents.run.folder import PREFIX
from msg_agents.run.result import RunResult, read_steps
from msg_agents.run.runner import run_network
from msg_agents.run.supervisor import STEPS
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.twin.simulate import simulate

Command = ForkedCommand | subprocess.Popen[str]
PROGRAM = Path(sys.executable).with_name("msg-agents")
PLAIN_RECORDER = Path(__file__).parents[1] / "support" / "plain_recorder.py"
ensure_running()  # it imports while tests are collected, and serves all of them
LOOK = 0.5  # s between two looks at what the processes of a test have made for themselves


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Tests of random faults take a ``repetition``: once by default, as often as ``make stress`` says otherwise."""
    if "repetition" in metafunc.fixturenames:
        count = int(os.environ.get("STRESS", "1"))
        metafunc.parametrize("repetition", range(count), ids=[f"repetition_{i}" for i in range(count)])


@dataclass(frozen=True)
class Process:
    """A process of the test, told from a later one with the same number by the time of its start."""

    pid: int
    born: str
    command: tuple[str, ...]

    @property
    def kind(self) -> str:
        """Command of msg-agents that it runs: agent, switcher, recorder, run, ..., or node_server."""
        if "msg_agents.cli.node_server" in self.command:
            return "node_server"
        for program in ("msg_agents", "msg-agents", str(PROGRAM)):
            if program in self.command:
                return self.command[self.command.index(program) + 1]
        return self.command[0] if self.command else ""

    @property
    def agent(self) -> int:
        """The first of its agents."""
        return int(self.command[self.command.index("--agent") + 1])

    @property
    def alive(self) -> bool:
        return _born(self.pid) == self.born

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        if self.alive:
            os.kill(self.pid, number)


def _mapped(pid: int) -> set[Path]:
    """Files of Fast DDS in shared memory that a process has mapped."""
    with contextlib.suppress(OSError):
        return {Path(name) for name in re.findall(r"/dev/shm/fastrtps\w+", Path(f"/proc/{pid}/maps").read_text())}
    return set()


def _read(path: str) -> bytes:
    """Without buffers: tests look at all processes again and again."""
    with open(path, "rb", buffering=0) as file:  # noqa: PTH123
        return file.read()


def _born(pid: int) -> str | None:
    """Start time of a living process; None for one that has ended, reaped or not."""
    try:
        fields = _read(f"/proc/{pid}/stat").decode().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in "ZX" else fields[19]


@dataclass(frozen=True)
class Network:
    """What a test does with its processes."""

    mark: str
    directory: Path
    traces: set[Path] = field(default_factory=set)  # what nobody should find after the end
    commands: list[Command] = field(default_factory=list)  # that it has started
    _looked: list[float] = field(default_factory=lambda: [0.0])

    def processes(self, *kinds: str) -> list[Process]:
        """Living processes of this test, of all kinds or only of some."""
        forked = [command for command in self.commands if isinstance(command, ForkedCommand)]
        found = [Process(one.pid, born, tuple(one.args)) for one in forked if (born := _born(one.pid))]
        wanted = f"{MARK}={self.mark}".encode()
        for name in filter(str.isdigit, os.listdir("/proc")):  # noqa: PTH208  as cheap as can be
            try:
                if wanted not in _read(f"/proc/{name}/environ"):
                    continue
                command = re.split("[\0 ]", _read(f"/proc/{name}/cmdline").decode().rstrip("\0 "))
            except OSError:
                continue
            born = _born(int(name))
            if born is not None:
                found.append(Process(int(name), born, tuple(command)))
        self._look(found)
        return [process for process in found if not kinds or process.kind in kinds]

    def _look(self, processes: list[Process]) -> None:
        """Note what they have made for themselves."""
        if time.monotonic() < self._looked[0] + LOOK:
            return
        self._looked[0] = time.monotonic()
        for process in processes:
            self.traces.update(_mapped(process.pid))
            for word in process.command:
                if found := re.match(rf"(/.*/{PREFIX}[^/]*)/", word):
                    self.traces.add(Path(found[1]))

    def nodes(self) -> list[Process]:
        """The processes of the network itself."""
        return self.processes("agent", "switcher", "recorder")

    def run_file(self) -> Path:
        """The run record of the run."""
        (path,) = {word for node in self.nodes() for word in node.command if word.endswith("run.json")}
        return Path(path)

    def shared_memory(self) -> set[Path]:
        """Files of Fast DDS in shared memory that the nodes have mapped: a killed node would leave them behind."""
        return {path for node in self.nodes() for path in _mapped(node.pid)}

    def start(
        self, *arguments: str | Path, program: str = "msg-agents", first: Callable[[], object] | None = None
    ) -> ForkedCommand:
        """Start a command with these arguments; ``first``: what the process does before."""
        late = ("--max-missed", "1") if arguments[:1] == ("run",) else ()  # no verdict here depends on a busy machine
        command = ForkedCommand(program, (*arguments, *late), os.environ | {"NO_COLOR": "1"}, first=first)
        self.commands.append(command)
        return command

    def execute(self, *arguments: str | Path, machine: Sequence[str] = (), **environment: str) -> subprocess.Popen[str]:
        """The same, as from a shell, by words before it, and with variables that are read when a program starts."""
        return self.program(*machine, PROGRAM, *arguments, **environment)

    def program(self, *arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
        """Start any program."""
        command = subprocess.Popen(
            [*(str(argument) for argument in arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"NO_COLOR": "1", **environment},
        )
        self.commands.append(command)
        return command

    def record(self, file: Path, *options: str | Path) -> ForkedCommand:
        """Start ``msg-agents run`` without a verdict."""
        return self.start(*self.recording(file), *options)

    def recording(self, file: Path) -> tuple[str | Path, ...]:
        """Command of a run without a verdict."""
        return "run", file, "--out", self.directory / "runs", "--no-analyse"

    experiment = staticmethod(experiment)

    def file(self, name: str = "net.yaml", **changes: Any) -> Path:
        """An experiment file."""
        path = self.directory / name
        path.write_text(yaml.safe_dump(document(**changes)))
        return path

    def bag(self) -> Path:
        """The only run."""
        (bag,) = (self.directory / "runs").iterdir()
        return bag

    def run(self, what: Experiment, *, fails: bool = False, **options: Any) -> RunResult:
        """A whole run from this process, without comparison and report."""
        result = run_network(what, self.directory / "runs", **options)
        assert bool(result.failures) == fails, result.failures
        return result

    @staticmethod
    def ended(process: Command, code: int = 0) -> tuple[str, str]:
        """Wait for the end of a process with this exit code; what it has printed."""
        stdout, stderr = process.communicate(timeout=150)
        assert process.returncode == code, stdout + stderr
        assert "Traceback" not in stderr
        return stdout, stderr

    @classmethod
    def result(cls, process: Command, code: int = 0) -> dict[str, Any]:
        """The same of one that prints JSON; its object."""
        found: dict[str, Any] = json.loads(cls.ended(process, code)[0])
        return found

    @classmethod
    def completed(cls, run: Command) -> dict[str, Any]:
        """Wait for the end of ``msg-agents run --json``: all is there, once, and as the twin says."""
        # Its result comes back, and what it noted on the way. Whether a run agrees with the prediction depends on its
        # seed only, so most runs are not analysed.
        stdout, stderr = cls.ended(run)
        assert stdout.count("\n") == 1
        result: dict[str, Any] = json.loads(stdout)
        assert result["failures"] == []
        saved = Path(result["bag"]) / "result.json"
        assert saved.exists() == (result["verdict"] is not None)
        assert not saved.exists() or json.loads(saved.read_text()) == result
        trajectory = read_bag(result["bag"])
        assert_equal_to_twin(trajectory)
        return result | {"notes": re.findall(r"^note: (.*)", stderr, re.MULTILINE)}

    def killed_and_back(self, run: Command, victims: Callable[[], Sequence[Process]], times: int = 1) -> Run:
        """Kill these processes of agents in the middle of a run, which must restart them; the run."""
        self.wait_for_steps()
        for _ in range(times):
            for victim in self.wait_for(victims, 30, "a living agent"):
                victim.kill()
        result = self.result(run)
        assert len(result["restarts"]) >= 1
        return read_bag(result["bag"])

    def any_agent(self) -> list[Process]:
        """A living process of agents, if there is one: the same of the same ones."""
        return random.Random(1).choices(there) if (there := self.processes("agent")) else []

    def recorded_bytes(self, out: str = "runs") -> int:
        """Size of what has been recorded so far."""
        return sum(file.stat().st_size for file in (self.directory / out).glob("*/*.mcap"))

    wait_for = staticmethod(wait_for)

    def wait_until_moving(self, out: str = "runs") -> None:
        """The run is in the middle: what is there of the bag is more than its head."""
        # The recorder writes once a second, so runs of fewer than some thousand steps may be over by then.
        self.wait_for(lambda: self.recorded_bytes(out) > 50_000, 60, "recorded states")

    def wait_for_steps(self, more_than: int = 0) -> Path:
        """Every agent has made so many steps, which the run knows within 0.3 s; the file in which their steps are."""
        self.wait_for(self.nodes, 60, "processes")
        steps: Path = self.run_file().with_name(STEPS)
        self.wait_for(lambda: min(read_steps(steps) or [-1]) > more_than, 60, "steps")
        return steps


@pytest.fixture
def network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    mark = uuid.uuid4().hex
    monkeypatch.setenv(MARK, mark)
    monkeypatch.setattr(fork_server, "programs", SimpleNamespace(start=start_program))
    for name in list(os.environ):
        if name.startswith(("ROS_DOMAIN", "ROS_AUTOMATIC", "ROS_STATIC", "FASTDDS_", "FASTRTPS_")):
            monkeypatch.delenv(name)
    network = Network(mark, tmp_path)
    yield network
    left = network.processes()
    if left:
        print(describe([process.pid for process in left], [path for path in network.traces if path.is_dir()]))
        for process in left:
            process.kill()
        print(last_line(network.commands))
    assert not left, "processes outlived the test"
    traces = {path for path in network.traces if path.exists()}
    if traces:  # some names are common to all domains: a process of another test may have such a file by now
        traces -= {path for process in Path("/proc").glob("[0-9]*") for path in _mapped(int(process.name))}
    assert traces == set()


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> random.Random:
    """Chance of a test's own. To repeat a failure, run the same test with the same STRESS and STRESS_SEED."""
    seed = f"{os.environ.get('STRESS_SEED', '0')} {request.node.name}"
    print(
        f"STRESS={os.environ.get('STRESS', '1')} STRESS_SEED={os.environ.get('STRESS_SEED', '0')} {request.node.nodeid}"
    )
    return random.Random(seed)


@pytest.fixture
def domain(network: Network, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain of the test's own, in its environment."""
    with free_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture
def twin_bag(network: Network) -> Path:
    """300 steps of five agents, 15 s."""
    bag = Path(network.directory / "twin")
    write_trajectory(simulate(network.experiment()), bag)
    return bag


@pytest.fixture
def terminal(network: Network) -> Iterator[Callable[..., Terminal]]:
    """Start a command on a terminal of its own."""
    opened: list[Terminal] = []

    def start(*command: str | Path, **options: Any) -> Terminal:
        opened.append(Terminal(*command, **options))
        return opened[-1]

    yield start
    for each in opened:
        each.close()


@pytest.fixture
def plain(network: Network) -> Iterator[Callable[[Path, dict[str, int]], subprocess.Popen[str]]]:
    """Start ``tests/support/plain_recorder.py`` for so many messages of these topics, of all together."""
    with started_processes() as started:

        def start(file: Path, topics: dict[str, int]) -> subprocess.Popen[str]:
            total = str(sum(topics.values()))
            started.append(
                subprocess.Popen(
                    [sys.executable, "-P", "-c", PLAIN_RECORDER.read_text(), file, total, *topics],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            return started[-1]

        yield start
