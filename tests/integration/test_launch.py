"""The launch files under the real ``ros2 launch``, with the workspace as colcon has installed it."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from started_processes import started_processes
from terminal import Terminal

from msg_agents.run.folder import PREFIX
from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check

NODES = {"agent", "switcher", "recorder", "player", "live"}


def missing() -> str | None:
    """What is not there of all that these tests need."""
    if not shutil.which("ros2"):
        return "ros2"
    for name in ("launch", "launch_ros", "ros2launch", "msg_agents", "msg_agents_bringup"):
        places = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        if not any((Path(place) / "share" / name / "package.xml").is_file() for place in places if place):
            return f"the package {name} on AMENT_PREFIX_PATH"
    return None


pytestmark = [
    pytest.mark.skipif(missing() is not None, reason=f"this machine: no ros2 launch: there is not {missing()}"),
    pytest.mark.usefixtures("domain", "older"),
]

Launch = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def older(network: Any) -> Iterator[None]:
    """Shared memory of killed processes of others: participants use it again, and nobody removes it."""
    there = set(Path("/dev/shm").glob("fastrtps*"))
    yield
    network.traces.difference_update(there)


@pytest.fixture
def launch(network: Any) -> Iterator[Launch]:
    """Start ``ros2 launch`` with these words, in a process group of its own and without a terminal."""
    with started_processes() as started:

        def start(*words: str | Path) -> subprocess.Popen[str]:
            started.append(
                subprocess.Popen(
                    command(*words),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    start_new_session=True,
                )
            )
            return started[-1]

        yield start


def command(*words: str | Path) -> list[str]:
    ros2 = shutil.which("ros2")
    assert ros2
    return [ros2, "launch", *map(str, words)]


def bringup(file: str, **arguments: object) -> list[str]:
    return ["msg_agents_bringup", file, *(f"{name}:={value}" for name, value in arguments.items())]


def of_network(network: Any, **arguments: object) -> list[str]:
    """A network that is recorded but not compared."""
    given = {"experiment": network.file(), "out": network.directory / "runs", "analyse": "false"} | arguments
    return bringup("network.launch.py", **given)


def nodes(network: Any) -> dict[str, Any]:
    """Running nodes by executable; of the agents, the number is part of it."""
    found = {}
    for process in network.processes():
        for word in process.command[:3]:
            if Path(word).name in NODES and Path(word).parent.name == "msg_agents":
                number = f"_{process.agent}" if "--agent" in process.command else ""
                found[Path(word).name + number] = process
    return found


def moving(network: Any) -> None:
    """Wait until the network is in the middle of its run."""
    network.wait_until_moving()
    network.processes()  # it notes what they have made for themselves


def errors(output: str) -> list[str]:
    """The errors that launch printed itself."""
    return re.findall(r"^\[ERROR\] \[launch\]: (.*)$", output.replace("\r\n", "\n"), re.M)


def bags(network: Any) -> list[Path]:
    return sorted(path for path in (network.directory / "runs").glob("*") if (path / "metadata.yaml").exists())


def complete(bag: Path) -> bool:
    trajectory = read_bag(bag)
    outcome = check(trajectory)
    return trajectory.completeness.complete and (outcome.difference, outcome.missing) == (None, 0)


LONG = {"duration": 5000}


def test_a_run_to_its_end(network: Any, launch: Launch) -> None:
    """It ends by itself; the bag equals the twin, its files as asked for."""
    process = launch(*of_network(network, split_size=0.1, compression="lz4", duration=30, parameter_services="true"))
    output, _ = process.communicate(timeout=100)
    assert process.returncode == 0, output
    assert errors(output) == []
    (bag,) = bags(network)
    assert complete(bag)
    assert len(list(bag.glob("*.mcap"))) > 1
    assert (bag / "log/run.json").is_file()


def test_two_networks_in_one_launch_file(network: Any, launch: Launch) -> None:
    """The one that ends first leaves the other, and its comparison, alone."""
    includes = "".join(
        "IncludeLaunchDescription(file, launch_arguments={"
        f"'experiment': {str(network.file(f'{name}.yaml'))!r}, 'namespace': '/{name}',"
        f"'duration': '{duration}', 'out': {str(network.directory / 'runs')!r}}}.items()),"
        for name, duration in (("one", 5), ("two", 20))
    )
    file = network.directory / "two.launch.py"
    file.write_text(
        "from ament_index_python.packages import get_package_share_directory\n"
        "from launch import LaunchDescription\n"
        "from launch.actions import IncludeLaunchDescription\n\n\n"
        "def generate_launch_description():\n"
        "    file = get_package_share_directory('msg_agents_bringup') + '/launch/network.launch.py'\n"
        f"    return LaunchDescription([{includes}])\n"
    )
    process = launch(file)
    output, _ = process.communicate(timeout=110)
    assert len(bags(network)) == 2, output
    assert all(complete(bag) and (bag / "report.html").is_file() for bag in bags(network)), output
    disagreements = [
        line for line in errors(output) if line.endswith("msg-analysis: the run disagrees with the prediction")
    ]
    assert errors(output) == disagreements  # which, is a matter of the seed
    assert process.returncode == (1 if disagreements else 0)


def beside_another(network: Any, launch: Launch, shutdown: str) -> subprocess.Popen[str]:
    """A network in a launch file that starts another process, too."""
    file = network.directory / "other.launch.xml"
    arguments = dict(word.split(":=", 1) for word in of_network(network, duration=2, shutdown=shutdown)[2:])
    given = "".join(f'<arg name="{name}" value="{value}"/>' for name, value in arguments.items())
    file.write_text(
        f'<launch><executable cmd="{sys.executable} -c &quot;import time; time.sleep(600)&quot;"/>'
        f'<include file="$(find-pkg-share msg_agents_bringup)/launch/network.launch.py">{given}</include></launch>'
    )
    return launch(file)


def ends_well(network: Any, process: subprocess.Popen[str]) -> None:
    output, _ = process.communicate(timeout=60)
    assert complete(bags(network)[0])
    assert (process.returncode, errors(output)) == (0, []), output


def test_a_network_that_ends_the_launch(network: Any, launch: Launch) -> None:
    ends_well(network, beside_another(network, launch, "true"))


def test_others_of_the_launch_go_on(network: Any, launch: Launch) -> None:
    process = beside_another(network, launch, "false")
    words = network.wait_for(lambda: [w for p in nodes(network).values() for w in p.command], 30, "nodes")
    folder = next(Path(word).parent for word in words if word.endswith("run.json"))
    network.wait_for(lambda: not folder.exists(), 60, "the end of the network, as launch sees it")
    assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    ends_well(network, process)


def test_sigint_to_the_process_group(network: Any, launch: Launch) -> None:
    """As from a cancelled CI job: launch passes it on, so that each process gets it twice. Nothing is left."""
    process = launch(*of_network(network, **LONG))
    moving(network)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    (bag,) = bags(network)
    assert errors(output)[-1].endswith(f": stopped by Ctrl-C: the run is not complete; its data so far are in {bag}"), (
        output
    )
    assert set(re.findall(r"exit code (\S+), cmd", output)) <= {"3"}, output
    assert "Traceback" not in output
    assert not read_bag(bag).completeness.complete


def test_ctrl_c_in_a_terminal(network: Any) -> None:
    terminal = Terminal(*command(*of_network(network, **LONG)), columns=500)
    try:
        network.wait_for(lambda: terminal.read(0.1) is None or network.recorded_bytes() > 50_000, 60, "states")
        network.processes()
        terminal.type(b"\x03")
        assert terminal.read_to_the_end() == 1
    finally:
        terminal.close()
    assert "stopped by Ctrl-C: the run is not complete; its data so far are in" in errors(terminal.text)[-1]
    assert bags(network)


@pytest.mark.parametrize("when", ["starting", "moving"])
def test_a_killed_process(network: Any, launch: Launch, when: str) -> None:
    """The others are stopped without errors of their own; the last error says what was killed."""
    process = launch(*of_network(network, **LONG))
    if when == "moving":
        moving(network)
    victim = network.wait_for(lambda: nodes(network).get("agent_2"), 30, "an agent")
    victim.kill()
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "agent_2: killed by SIGKILL: the run is not complete" in errors(output)[-1], output
    assert not re.search(r"\] (error|Error|Traceback)", output), output
    network.traces.clear()  # what a killed process leaves behind is in shared memory


def test_sigterm_to_launch(network: Any, launch: Launch) -> None:
    """Launch ends without a word to its processes: they end by themselves."""
    process = launch(*of_network(network, **LONG))
    moving(network)
    process.terminate()
    output, _ = process.communicate(timeout=60)
    assert process.returncode != 0, output
    network.wait_for(lambda: not network.processes(), 30, "the end of all processes")
    abandoned = {path for path in network.traces if path.name.startswith(PREFIX)}
    network.traces.difference_update(abandoned)  # if launch is killed, the next run removes its folder
    (bag,) = bags(network)
    assert not read_bag(bag).completeness.complete


@pytest.mark.parametrize(
    ("file", "arguments", "words"),
    [
        ("network", {"dration": 5}, "dration:=5: this launch file has no argument dration: did you mean duration?"),
        ("network", {"duration": -5}, "duration:=-5: run.duration: -5.0: expected a number > 0"),
        ("network", {"speed": 10}, "speed:=10: a run in lockstep has no speed: add pace:=realtime"),
        ("replay", {"bag": "/", "rate": "x"}, "rate:=x: expected a positive number, or max"),
    ],
)
def test_wrong_arguments(network: Any, launch: Launch, file: str, arguments: dict[str, object], words: str) -> None:
    """All of them: tests/agents/run/test_launch.py."""
    process = (
        launch(*bringup(f"{file}.launch.py", out=network.directory / "runs", **arguments))
        if (file == "network")
        else launch(*bringup(f"{file}.launch.py", **arguments))
    )
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert words in errors(output)[-1], output
    assert "process started" not in output
    assert not (network.directory / "runs").exists()


def test_a_replay(network: Any, launch: Launch, twin_bag: Path) -> None:
    """It ends with the bag."""
    process = launch(*bringup("replay.launch.py", bag=twin_bag, rate="max"))
    output, _ = process.communicate(timeout=100)
    assert (process.returncode, errors(output)) == (0, []), output
    assert "messages played" in output


def test_a_launch_test_with_a_claim(tmp_path: Path) -> None:
    """The example of the documentation: its record agrees, and the claim, of one run, is open."""
    pytest.importorskip("launch_testing")
    example = Path(__file__).parents[2] / "docs/external_agent/robot_launch_test.py"
    command = [sys.executable, "-m", "launch_testing.launch_test", str(example)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert len(json.loads((tmp_path / "launched/error.json").read_text())["values"]) == 1
