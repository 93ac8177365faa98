"""A process that is killed or stopped, a full disk, a user who ends the run: what is there can be read."""

import contextlib
import itertools
import json
import os
import random
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from msg_agents.discovery.rtps import LOOPBACK, discovery_ports, disposal_message
from msg_agents.run.result import read_steps
from msg_analysis.bags.reading import read_bag
from msg_analysis.runs import read_result
from msg_analysis.twin.check import check

# 20,000 steps: no test waits for them; of states that are soon seen in the bag
LONG = {"duration": 1000, "replicas": 16, "processes": 2}
MIDDLE = 100  # steps of all agents, of which the recorder has some
NAMES = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
THIRTY = [*range(1, 31)]
LARGE = {
    "graphs": {"line": {"path": THIRTY}, "ring": {"cycle": THIRTY}},
    "run": {"duration": 100, "replicas": 1, "processes": 1},
}


@pytest.mark.parametrize("kind", ["agent", "switcher"])
def test_killed_child_that_may_not_come_back(network: Any, kind: str, rng: random.Random) -> None:
    run = network.record(network.file(run=LONG), "--restarts", "0")
    network.wait_for_steps(MIDDLE)
    kill_and_see(network, run, rng.choice(network.processes(kind)))


def test_killed_recorder(network: Any, repetition: int, rng: random.Random) -> None:
    """Every other time between its birth and, likely, the first state; else while states are recorded."""
    run = network.record(network.file(run=LONG))
    network.wait_for(lambda: len(network.nodes()) == 4, 60, "four children")
    early = repetition % 2 == 1
    if not early:
        network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 1.0))
    kill_and_see(network, run, network.processes("recorder")[0], early=early)


def kill_and_see(network: Any, run: subprocess.Popen[str], victim: Any, *, early: bool = False) -> None:
    """The whole run ends, and says why."""
    assert network.shared_memory() == set()  # nothing that the victim could leave behind
    kind = victim.kind
    victim.kill()
    _, stderr = network.ended(run, 3)
    assert network.processes() == []
    first = {1: "agents_1_to_2", 3: "agents_3_to_5"}[victim.agent] if kind == "agent" else kind
    assert re.search(rf"^failed: {first}: killed by SIGKILL", stderr, re.MULTILINE), stderr
    failed = re.findall(r"^failed: (agents?_\w+|switcher|recorder): ", stderr, re.MULTILINE)
    assert failed == [first], stderr
    bag = network.bag()
    assert (bag / "log" / f"{first}.log").exists()
    recorded = not early or bool(list(bag.glob("*.mcap")))
    assert ("nothing was recorded" in stderr) == (not recorded)
    if not recorded:
        return
    assert re.search(r"last recorded step: agent 1: (\d+|none), .*agent 5: (\d+|none)$", stderr, re.MULTILINE), stderr
    assert (bag / "metadata.yaml").exists()
    assert ("the bag was salvaged" in stderr) == (kind == "recorder")
    trajectory = read_bag(bag)
    assert not trajectory.completeness.complete
    assert early or trajectory.completeness.received > 0
    assert check(trajectory).difference is None


def test_in_the_middle(network: Any, repetition: int, rng: random.Random) -> None:
    number = signal.SIGTERM if repetition % 2 else signal.SIGINT
    run = network.start("run", network.file(run=LONG), "--out", network.directory / "runs", "--json")
    network.wait_for_steps(MIDDLE)
    time.sleep(rng.uniform(0.0, 1.0) if repetition else 0.0)
    assert network.shared_memory() == set()
    run.send_signal(number)
    stdout, stderr = network.ended(run, 3)
    assert network.processes() == []
    assert re.search(rf"^failed: stopped by {NAMES[number]} at step \d+ of 20000$", stderr, re.M)
    assert "Traceback" not in stderr
    assert stdout.count("\n") == 1  # one JSON object

    bag = network.bag()
    result = json.loads(stdout)
    assert (result["verdict"], result["bag"], result["report"]) == ("incomplete", str(bag), None)
    assert result == json.loads((bag / "result.json").read_text())
    assert read_result(bag).verdict == "incomplete"  # as `msg-analysis tabulate` does
    custom = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
    assert custom["complete"] == "false"
    assert "salvaged" not in custom
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        count = sum(1 for connection, *_ in reader.messages() if connection.topic.endswith("/state"))
    trajectory = read_bag(bag)
    assert trajectory.completeness.received == count > 0
    assert not trajectory.completeness.complete
    assert check(trajectory).difference is None


def test_before_anything_has_begun(network: Any, repetition: int, rng: random.Random) -> None:
    """While the processes start and look for each other."""
    run = network.record(network.file(run=LONG))
    network.wait_for(network.nodes, 60, "a child")
    time.sleep(rng.uniform(0.0, 1.5) if repetition else 0.0)
    number = signal.SIGINT if repetition % 2 else signal.SIGTERM
    run.send_signal(number)
    _, stderr = network.ended(run, 3)
    assert f"failed: stopped by {NAMES[number]} " in stderr
    assert "Traceback" not in stderr
    assert network.processes() == []


@pytest.mark.parametrize(
    ("there", "changes", "words"),
    [
        ("log/run.json", LARGE, "run was compared with the prediction"),
        ("log", {"run": {"duration": 5, "replicas": 500}}, ".+"),
    ],
    ids=["compared", "at any moment"],
)
def test_after_the_network(network: Any, there: str, changes: dict[str, Any], words: str) -> None:
    """The user does not wait for the verdict. The result is printed; the bag is whole, and can be compared later."""
    # The comparison takes longer than this test needs to see that the logs are there, or as soon as they are being
    # kept.
    run = network.start("run", network.file(**changes), "--out", network.directory / "runs", "--json")
    network.wait_for(lambda: list(network.directory.glob(f"runs/*/{there}")), 60, "the end of the network")
    time.sleep(0.2 if there == "log/run.json" else 0.0)
    run.send_signal(signal.SIGINT)
    stdout, stderr = network.ended(run, 3)
    assert re.fullmatch(f"failed: stopped by Ctrl-C while the {words}", stderr.splitlines()[-1])
    bag, result = network.bag(), json.loads(stdout)
    assert (result["verdict"], result["bag"], result["report"]) == ("incomplete", str(bag), None)
    assert result == json.loads((bag / "result.json").read_text())
    assert read_bag(bag).completeness.complete


def test_agents_that_are_interrupted_say_nothing(network: Any) -> None:
    """A signal shuts rclpy down between two calls of a callback, and what is then published is no error of ours."""
    fast = LONG | {"pace": "realtime", "speed": 60.0}
    run = network.record(network.file(run=fast), "--restarts", "0")
    network.wait_for_steps(MIDDLE)
    agents = network.processes("agent")
    for process in agents:
        os.kill(process.pid, signal.SIGINT)
    network.ended(run, 3)
    bag = network.bag()
    for log in (bag / "log").glob("*.log"):
        assert not re.search("FATAL|Traceback|Error", log.read_text()), log


def test_a_killed_runner_takes_everybody_along(network: Any) -> None:
    run = network.record(network.file(run=LONG))
    network.wait_for_steps(MIDDLE)
    assert {process.kind for process in network.nodes()} == {"agent", "switcher", "recorder"}
    run.kill()
    run.communicate(timeout=60)
    network.wait_for(lambda: network.processes() == [], 10, "the end of every child")
    network.traces.clear()  # whoever runs the next network clears its folder away
    bag = network.bag()
    trajectory = read_bag(bag)  # its recorder had the time to close it
    assert trajectory.completeness.received > 0
    assert check(trajectory).difference is None


@pytest.mark.timeout(150)
def test_stopped_recorder(network: Any) -> None:
    """Everybody waits for it in the end, for longer than the 20 s after which DDS drops who is silent by default."""
    file = network.file(run={"duration": 100, "processes": 2})
    run = network.record(file, "--json")
    steps = network.wait_for_steps()
    (recorder,) = network.processes("recorder")
    recorder.kill(signal.SIGSTOP)
    network.wait_for(lambda: min(read_steps(steps)) == 2000, 90, "the last step")
    time.sleep(22.0)
    recorder.kill(signal.SIGCONT)
    result = network.completed(run)
    assert result["restarts"] == []
    assert any(f": stopped, and waited for: recorder (PID {recorder.pid})" in note for note in result["notes"])


LONGEST_STOP = 120.0 if "STRESS" in os.environ else 2.0  # s


@pytest.mark.timeout(600)
def test_stopped_processes(network: Any, repetition: int, rng: random.Random) -> None:
    """Any of the run, up to all, for any time: the others wait for them, and nothing is lost."""
    file = network.file(run={"duration": 200, "processes": rng.choice([2, 5])})
    run = network.record(file, "--json")
    network.wait_for_steps()
    time.sleep(rng.uniform(0.0, 0.5))
    there = sorted(network.processes(), key=lambda process: process.pid)
    victims = rng.sample(there, rng.choice([1, len(there), rng.randint(1, len(there))]))
    for process in victims:
        process.kill(signal.SIGSTOP)
    time.sleep(rng.uniform(1.0, LONGEST_STOP))
    for process in rng.sample(victims, len(victims)):
        process.kill(signal.SIGCONT)
    assert network.completed(run)["restarts"] == []


def test_messages_that_do_not_arrive_any_more(network: Any, domain: int) -> None:
    """All processes run, but the others take one of them for gone: who waits for whom is said, and the run ends."""
    what = network.experiment(run=LONG | {"processes": 5})

    numbers, prefixes = itertools.count(1 << 30), []

    def part(step: int) -> None:
        """As soon as agents make steps, say again and again in the name of agent 1 that it has left."""
        if step > 0 and not prefixes:
            (agent,) = [each for each in network.processes("agent") if each.agent == 1]
            checkpoints = Path(agent.command[agent.command.index("--checkpoint") + 1])
            prefixes.append((checkpoints / "agent_1.participant").read_bytes())
        for prefix, port in itertools.product(prefixes, discovery_ports(domain)):
            with contextlib.suppress(OSError):
                sender.sendto(disposal_message(prefix, next(numbers)), (LOOPBACK, port))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        result = network.run(what, domain=domain, on_progress=part, stuck_timeout=4.0, fails=True)
    assert re.match(
        r"no step for 4 s at step \d+, though all processes run: .*agent_\d: at step.*: run it again$",
        result.failures[0],
    )
    assert check(result.trajectory).difference is None


@pytest.fixture
def small_disk(tmp_path: Path, rng: random.Random) -> Iterator[Path]:
    """A file system of its own, of about 1 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    size = f"size={rng.randrange(700, 1300)}k"
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", disk], capture_output=True, check=False)
    if mount.returncode:
        pytest.skip("run as root: only root can mount a small file system")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_full_disk(network: Any, small_disk: Path, repetition: int) -> None:
    """The run ends, says why, and what was written can be read."""
    # 20,000 steps, of states that fill it in some 2,000.
    file = network.file(run={"duration": 1000, "replicas": 8, "processes": 2})
    run = network.start("run", file, "--out", small_disk)
    _, stderr = network.ended(run, 3)
    assert re.search(r"^failed: recorder: .*No space left on device", stderr, re.MULTILINE), stderr
    assert network.processes() == []
    (bag,) = (path for path in small_disk.iterdir() if path.is_dir())
    trajectory = read_bag(bag)
    assert trajectory.completeness.received > 1000
    assert check(trajectory).difference is None
