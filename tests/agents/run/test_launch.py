"""What launch files do, without ``launch``. With it: tests/integration/test_launch.py."""

import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

from msg_agents.process_layout import lay_out_network
from msg_agents.run.folder import PREFIX
from msg_agents.run.launch import (
    ANALYSIS,
    NETWORK_ARGUMENTS,
    REPLAY_ARGUMENTS,
    LaunchedNetwork,
    LaunchedReplay,
    bag_storage,
    check_names,
    player_options,
)
from msg_analysis.errors import InputError
from msg_analysis.model.run_record import RunRecord

BRINGUP = Path(__file__).parents[3] / "ros_ws/src/msg_agents_bringup"
NETWORK = {name: default for name, (default, _) in NETWORK_ARGUMENTS.items()} | {"duration": "1"}
REPLAY = {name: default for name, (default, _) in REPLAY_ARGUMENTS.items()}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"experiment": "lin_ring"},
            "experiment:=lin_ring: no such file, .*: expected a file, or one of discrete, .*line_ring",
        ),
        ({"experiment": "nowhere.yaml"}, "nowhere.yaml"),
        ({"experiment": "line_ring.yaml"}, "^experiment:=line_ring.yaml: no such file: .* or give line_ring"),
        ({"record": "perhaps"}, "record:=perhaps: expected true or false"),
        ({"shutdown": "false", "parameter_services": "2"}, "parameter_services:=2: expected true or false"),
        ({"seed": "1.5"}, "seed:=1.5: expected a whole number"),
        ({"duration": "long"}, "duration:=long: expected a number"),
        ({"duration": "-5"}, r"^duration:=-5: run\.duration: -5.0: expected a number > 0"),
        ({"pace": "slow", "seed": "3"}, r'^pace:=slow: run\.pace: "slow"'),
        ({"pace": "slow", "seed": "-3"}, r"^seed:=-3, pace:=slow: 2 problems"),
        ({"processes": "0"}, r"^processes:=0: run\.processes"),
        ({"speed": "10"}, "speed:=10: a run in lockstep has no speed: add pace:=realtime"),
        ({"compression": "zip"}, "compression: 'zip': expected one of none, zstd, lz4"),
        ({"split_size": "x"}, "split_size:=x: expected a number above 0"),
        ({"split_size": "0.01"}, "split_size:=0.01: expected at least 0.1"),
        ({"out": "/dev/null"}, "out:=/dev/null: "),
        ({"pace": "realtime", "experiment": "nowhere.yaml"}, "nowhere"),
    ],
)
def test_of_a_network(tmp_path: Path, changes: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        LaunchedNetwork(NETWORK | {"out": str(tmp_path / "runs")} | changes)
    assert not (tmp_path / "runs").exists()


def test_of_a_network_with_robots(tmp_path: Path) -> None:
    file = tmp_path / "net.yaml"
    file.write_text("{name: net, graphs: {line: {path: [1, 2]}}, run: {external: [2]}}")
    with pytest.raises(InputError, match=r"run.external: a launch file starts all agents: use `msg-agents run`"):
        LaunchedNetwork(NETWORK | {"out": str(tmp_path / "runs"), "experiment": str(file)})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bag": ""}, "bag: not given"),
        ({"bag": "/nowhere"}, "bag: /nowhere"),
        ({"loop": "yes"}, "loop:=true"),
        ({"rate": "x"}, "rate:=x: expected a positive number, or max"),
        ({"rate": "-1"}, "rate:=-1"),
        ({"rate": "inf"}, "rate:=inf"),
        ({"clock": "0"}, "clock:=0: expected a number above 0"),
        ({"clock": "often"}, "clock:=often: expected a number above 0"),
    ],
)
def test_of_a_replay(tmp_path: Path, changes: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        player_options(REPLAY | {"bag": str(tmp_path)} | changes)


def test_right_ones(tmp_path: Path) -> None:
    storage = bag_storage(NETWORK | {"split_size": "2.5", "compression": "none"})
    assert (storage.compression, storage.split_size) == ("none", 2_500_000)
    options = player_options(REPLAY | {"bag": str(tmp_path), "live": "false", "loop": "true", "clock": "50"})
    assert options == [str(tmp_path), "--rate", "1", "--loop", "--clock", "50"]


def context(file: str, top: list[str], *words: str) -> Any:
    """As launch shows it to a launch file that is started by ``ros2 launch``: what was given, and in which file."""
    sources = [SimpleNamespace(launch_description_source=SimpleNamespace(location=name)) for name in top]
    event = SimpleNamespace(launch_description=SimpleNamespace(entities=sources))
    values = {"event": event, "current_launch_file_path": file}
    return SimpleNamespace(argv=words, get_locals_as_dict=lambda: values)


def test_misspelt_arguments() -> None:
    """Launch ignores them; but a file that is included may be given what concerns the other one."""
    known = list(NETWORK_ARGUMENTS)
    check_names(context("/a.py", ["/a.py"], "seed:=3", "sigterm_timeout:=9"), known)
    check_names(context("/a.py", ["/b.py"], "dration:=3"), known)
    with pytest.raises(InputError, match="dration:=3: this launch file has no argument dration: did you mean duration"):
        check_names(context("/a.py", ["/a.py"], "seed:=3", "dration:=3"), known)
    with pytest.raises(InputError, match=r"robot:=x: .*: expected one of experiment, out"):
        check_names(context("/a.py", ["/a.py"], "robot:=x"), known)


def test_they_are_documented() -> None:
    text = (BRINGUP.parents[2] / "docs/ros.md").read_text(encoding="utf-8")
    assert [name for name in {**NETWORK_ARGUMENTS, **REPLAY_ARGUMENTS} if f"`{name}`" not in text] == []


def launched(out: Path, **changes: str) -> LaunchedNetwork:
    return LaunchedNetwork(NETWORK | {"out": str(out)} | changes)


def end(network: LaunchedNetwork, *names: str, code: int = 0) -> None:
    """These processes, or all, end."""
    for name in names or [spec.name for spec in network.processes]:
        network.ended(name, code)


def temporary_folder(network: LaunchedNetwork) -> Path:
    (folder,) = {
        Path(word).parent for spec in network.processes for word in spec.arguments if word.endswith("run.json")
    }
    assert folder.name.startswith(PREFIX)
    return folder


def test_the_processes_are_those_of_the_runner(tmp_path: Path) -> None:
    network = launched(tmp_path, processes="2", seed="5", namespace="/lab")
    try:
        run_file = temporary_folder(network) / "run.json"
        record = RunRecord.from_json(run_file.read_text(), str(run_file))
        assert (record.experiment.run.seed, record.experiment.run.duration) == (5, 1.0)
        lock = ("--lifeline-lock", str(run_file.parent))
        processes = lay_out_network(record.experiment, run_file, network.bag)
        assert network.processes == [replace(spec, arguments=spec.arguments + lock) for spec in processes]
        assert [spec.name for spec in network.processes] == ["recorder", "agents_1_to_2", "agents_3_to_5", "switcher"]
        assert network.namespace == "/lab"
    finally:
        network.close()


def test_complete(tmp_path: Path) -> None:
    """The last process to end completes the run."""
    network = launched(tmp_path, processes="1")
    folder = temporary_folder(network)
    end(network, "agents_1_to_5", "switcher")
    assert network.analysis() is None
    network.ended("recorder", 0)
    assert network.analysis() == ["compare", str(network.bag), "--report", f"{network.bag}/report.html"]
    assert (network.over, network.analysis()) == (False, None)
    network.ended(ANALYSIS, 0)
    assert (network.over, network.reason, network.to_stop()) == (True, None, [])
    network.close()
    network.close()
    assert not folder.exists()
    assert list(tmp_path.iterdir()) == []  # nothing came of it: no bag directory is left


@pytest.mark.parametrize(("code", "words"), [(2, "exit code 2"), (-signal.SIGKILL, "killed by SIGKILL")])
def test_failed(tmp_path: Path, code: int, words: str) -> None:
    """Said once: the others end because of it, the recorder last. Until then they may read the run record."""
    network = launched(tmp_path, processes="1")
    network.ended("recorder", code)
    assert network.to_stop() == ["agents_1_to_5", "switcher"]
    network.close()
    network = launched(tmp_path, processes="2")
    assert network.to_stop() == []
    network.ended("agents_1_to_2", code)
    assert (network.to_stop(), network.to_stop()) == (["agents_3_to_5", "switcher"], [])
    network.interrupted("stopped by Ctrl-C")
    network.ended("switcher", 3)
    network.ended("agents_3_to_5", -signal.SIGTERM)
    assert network.to_stop() == ["recorder"]
    assert (temporary_folder(network) / "run.json").exists()
    network.ended("recorder", 3)
    assert (network.over, network.to_stop(), network.analysis()) == (True, [], None)
    assert network.reason == f"agents_1_to_2: {words}: the run is not complete"
    network.close()


def test_interrupted(tmp_path: Path) -> None:
    """What launch was told is the reason, not that its processes obeyed; data so far are kept with the run record."""
    network = launched(tmp_path, processes="1")
    (network.bag / f"{network.bag.name}_0.mcap").touch()
    network.interrupted("stopped by Ctrl-C")
    end(network, code=3)
    assert network.reason == f"stopped by Ctrl-C: the run is not complete; its data so far are in {network.bag}"
    network.close()
    assert (network.bag / "log/run.json").exists()


def test_interrupted_after_the_run(tmp_path: Path) -> None:
    """Before the comparison, which launch does not start any more, or during it."""
    before, during = launched(tmp_path, processes="1"), launched(tmp_path, processes="1")
    before.ended("agents_1_to_5", 0)
    before.interrupted("stopped by Ctrl-C")
    end(before, "switcher", "recorder")
    assert before.analysis() is None
    end(during)
    assert during.analysis() is not None
    during.interrupted("stopped by Ctrl-C")
    during.ended(ANALYSIS, 130)
    for when, network in (("before", before), ("during", during)):
        assert network.reason == f"stopped by Ctrl-C {when} the comparison: no verdict of {network.bag}"
        network.close()


@pytest.mark.parametrize(("code", "words"), [(1, "disagrees"), (3, "incomplete"), (2, "exit code 2")])
def test_verdict(tmp_path: Path, code: int, words: str) -> None:
    network = launched(tmp_path, processes="1")
    end(network)
    assert network.analysis()
    network.ended(ANALYSIS, code)
    network.close()
    assert words in network.reason


def test_nothing_to_analyse(tmp_path: Path) -> None:
    for changes in ({"analyse": "false"}, {"record": "false"}):
        network = launched(tmp_path, **changes)
        end(network)
        network.close()
        assert (network.over, network.analysis(), network.reason) == (True, None, None)
        assert ("recorder" in {spec.name for spec in network.processes}) == ("record" not in changes)


def test_replay(tmp_path: Path) -> None:
    replay = LaunchedReplay(REPLAY | {"bag": str(tmp_path), "rate": "max"})
    words = [spec.arguments[: spec.arguments.index("--lifeline-lock")] for spec in replay.processes]
    assert words == [("live", "--reliable"), ("player", str(tmp_path), "--rate", "max", "--await", "live")]
    replay.ended("player", 2)
    assert (replay.to_stop(), replay.reason) == (["live"], "player: exit code 2")
    replay.close()
    (player,) = LaunchedReplay(REPLAY | {"bag": str(tmp_path), "live": "false"}).processes
    assert player.name == "player"
