"""What launch files do, without ``launch``. With it: tests/integration/test_launch.py."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from msg_agents.process_layout import lay_out_network
from msg_agents.run.folder import PREFIX
from msg_agents.run.launch import ANALYSIS, NETWORK_ARGUMENTS, REPLAY_ARGUMENTS, LaunchedNetwork, LaunchedReplay
from msg_analysis.model.run_record import RunRecord

DEFAULTS = {name: default for name, (default, _) in NETWORK_ARGUMENTS.items()}


def launched(out: Path, **changes: str) -> LaunchedNetwork:
    return LaunchedNetwork(DEFAULTS | {"out": str(out), "duration": "1"} | changes)


def workshops(network: LaunchedNetwork) -> Path:
    (folder,) = {
        Path(word).parent for plan in network.processes for word in plan.arguments if word.endswith("run.json")
    }
    assert folder.name.startswith(PREFIX)
    return folder


def test_the_plan_is_that_of_the_runner(tmp_path: Path) -> None:
    network = launched(tmp_path, processes="2", seed="5", namespace="/lab")
    try:
        run_file = workshops(network) / "run.json"
        record = RunRecord.from_json(run_file.read_text(), str(run_file))
        assert (record.experiment.run.seed, record.experiment.run.duration) == (5, 1.0)
        assert network.bag is not None
        lifeline = ("--lifeline-lock", str(run_file.parent))
        plans = lay_out_network(record.experiment, run_file, network.bag)
        assert network.processes == [replace(plan, arguments=plan.arguments + lifeline) for plan in plans]
        assert [plan.name for plan in network.processes] == ["recorder", "agents_1_to_2", "agents_3_to_5", "switcher"]
        assert network.namespace == "/lab"
    finally:
        network.close()


def test_complete(tmp_path: Path) -> None:
    """The last process to end completes the run."""
    network = launched(tmp_path, processes="1")
    folder = workshops(network)
    for name in ("agents_1_to_5", "switcher"):
        network.ended(name, 0)
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
    network = launched(tmp_path, processes="2")
    assert network.to_stop() == []
    network.ended("agents_1_to_2", code)
    assert (network.to_stop(), network.to_stop()) == (["agents_3_to_5", "switcher"], [])
    network.interrupted("stopped by Ctrl-C")
    network.ended("switcher", 3)
    network.ended("agents_3_to_5", -signal.SIGTERM)
    assert network.to_stop() == ["recorder"]
    assert (workshops(network) / "run.json").exists()
    network.ended("recorder", 3)
    assert (network.over, network.to_stop(), network.analysis()) == (True, [], None)
    assert network.reason == f"agents_1_to_2: {words}: the run is not complete"
    network.close()


def test_a_recorder_that_failed(tmp_path: Path) -> None:
    network = launched(tmp_path, processes="1")
    network.ended("recorder", 2)
    assert network.to_stop() == ["agents_1_to_5", "switcher"]
    network.close()


def test_interrupted(tmp_path: Path) -> None:
    """What launch was told is the reason, not that its processes obeyed; data so far are kept with the run record."""
    network = launched(tmp_path, processes="1")
    assert network.bag is not None
    (network.bag / f"{network.bag.name}_0.mcap").touch()
    network.interrupted("stopped by Ctrl-C")
    for name in ("agents_1_to_5", "switcher", "recorder"):
        network.ended(name, 3)
    assert network.reason == f"stopped by Ctrl-C: the run is not complete; its data so far are in {network.bag}"
    network.close()
    assert (network.bag / "log/run.json").exists()


def test_interrupted_after_the_run(tmp_path: Path) -> None:
    """Before the comparison, which launch does not start any more, or during it."""
    for started in (False, True):
        network = launched(tmp_path, processes="1")
        for interrupted, name in ((False, "agents_1_to_5"), (not started, "switcher"), (False, "recorder")):
            if interrupted:
                network.interrupted("stopped by Ctrl-C")
            network.ended(name, 0)
        assert (network.analysis() is not None) == started
        if started:
            network.interrupted("stopped by Ctrl-C")
            network.ended(ANALYSIS, 130)
        when = "during" if started else "before"
        assert network.reason == f"stopped by Ctrl-C {when} the comparison: no verdict of {network.bag}"
        network.close()


@pytest.mark.parametrize(("code", "words"), [(1, "disagrees"), (3, "incomplete"), (2, "exit code 2")])
def test_verdict(tmp_path: Path, code: int, words: str) -> None:
    network = launched(tmp_path, processes="1")
    for plan in network.processes:
        network.ended(plan.name, 0)
    assert network.analysis()
    network.ended(ANALYSIS, code)
    network.close()
    assert network.reason is not None
    assert words in network.reason


def test_nothing_to_analyse(tmp_path: Path) -> None:
    for changes in ({"analyse": "false"}, {"record": "false"}):
        network = launched(tmp_path, **changes)
        for plan in network.processes:
            network.ended(plan.name, 0)
        network.close()
        assert (network.over, network.analysis(), network.reason) == (True, None, None)
        assert ("recorder" in {plan.name for plan in network.processes}) == ("record" not in changes)


def test_replay(tmp_path: Path) -> None:
    defaults = {name: default for name, (default, _) in REPLAY_ARGUMENTS.items()}
    replay = LaunchedReplay(defaults | {"bag": str(tmp_path), "rate": "max"})
    words = [plan.arguments[: plan.arguments.index("--lifeline-lock")] for plan in replay.processes]
    assert words == [("live", "--reliable"), ("player", str(tmp_path), "--rate", "max", "--await", "live")]
    replay.ended("player", 2)
    assert (replay.to_stop(), replay.reason) == (["live"], "player: exit code 2")
    replay.close()
    (player,) = LaunchedReplay(defaults | {"bag": str(tmp_path), "live": "false"}).processes
    assert player.name == "player"
