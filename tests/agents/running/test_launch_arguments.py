"""Wrong arguments of launch files: one error each that names the argument, before anything is started or made."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

from msg_agents.run.launch import (
    NETWORK_ARGUMENTS,
    REPLAY_ARGUMENTS,
    LaunchedNetwork,
    bag_storage,
    check_names,
    player_options,
)
from msg_analysis.errors import InputError

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
