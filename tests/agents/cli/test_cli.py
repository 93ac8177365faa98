"""The command line: what goes to stdout, what to stderr, and the exit codes; the same in a process of its own."""

import dataclasses
import json
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import Result
from networks import document as net
from programs import run

pytest.importorskip("rclpy")

from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.simulate import new_record, simulate


def document() -> dict[str, Any]:
    return net(3, name="small", run={"duration": 5, "replicas": 1, "seed": 5})


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def call(*words: str | Path) -> Result:
    return run("msg-agents", *words, NO_COLOR="1")


def refused(result: Result, *words: str) -> None:
    """Exit code 2, one error that names what is wrong, nothing on stdout, no traceback."""
    assert (result.exit_code, result.stdout) == (2, ""), result
    assert "Traceback" not in result.stderr
    errors = [line for line in result.stderr.splitlines() if line.lower().startswith("error:")]
    assert len(errors) == 1, result.stderr
    for word in words:
        assert word in result.stderr


@pytest.fixture
def small(tmp_path: Path) -> Path:
    file = tmp_path / "small.yaml"
    file.write_text(yaml.safe_dump(document()))
    return file


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    file = tmp_path / "run.json"
    file.write_text(new_record(Experiment.parse(document())).to_json())
    return file


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({"noise": {"loss": 0.5, "burst": 1}}, [], ["noise.burst: 1", "p / (1 - p)"]),
        ({"noise": {"loss": {"arcs": [[1, 4, 0.5]]}}}, [], ["noise.loss.arcs: [1, 4]", "4 hears 1"]),
        (
            {"agents": 201, "run": {"dt": 0.001, "start": "zero", "processes": "one_per_agent"}},
            [],
            ["run.processes", "at most 200"],
        ),
        ({}, ["--pace", "realtime", "--speed", "0"], ["run.speed: 0", "> 0"]),
        ({}, ["--pace", "fast"], ["error: --pace: run.pace", "fast"]),
        ({}, ["--processes", "many", "--seed", "1"], ["error: --processes: run.processes", "many"]),
        ({}, ["--processes", "0"], ["run.processes"]),
        ({"run": {"dt": -1}}, ["--seed", "1"], ["bad.yaml: run.dt"]),
        ({}, ["--seed", "-1"], ["run.seed", "-1"]),
        ({}, ["--duration", "nan"], ["run.duration"]),
        ({}, ["--duration", "0.07"], ["run.duration"]),
        ({}, ["--domain", "500"], ["--domain", "500"]),
        ({}, ["--seed", "many"], ["--seed"]),
        (
            {},
            ["--delivery", "best_effort"],
            ["--delivery: run.delivery: best_effort: in lockstep expected reliable, since"],
        ),
    ],
    ids=lambda value: json.dumps(value) if isinstance(value, dict) else " ".join(value),
)
def test_experiments_that_cannot_be_run(
    tmp_path: Path, changes: dict[str, Any], options: list[str], words: list[str]
) -> None:
    content = document()
    for key, value in changes.items():
        content[key] = {**content.get(key, {}), **value} if isinstance(value, dict) else value
    if content.get("agents"):
        content["graphs"] = {"star": {"star": {"center": 1}}, "all": {"complete": True}}
    file = tmp_path / "bad.yaml"
    file.write_text(yaml.safe_dump(content))
    refused(call("run", file, "--out", tmp_path / "runs", *options), *words)
    assert not (tmp_path / "runs").exists()  # nothing half-done


def test_channel_files(small: Path, tmp_path: Path) -> None:
    channel = tmp_path / "channel.yaml"
    channel.write_text("default: {loss: 2, delay: 3}\n")
    refused(call("run", small, "--channel", channel), "channel.yaml: 2 problems")
    channel.write_text("{}\n")
    options = ("--channel", channel, "--pace", "realtime", "--use-sim-time")
    refused(call("run", small, *options), "--use-sim-time: not with --channel")


def test_files_of_which_no_run_is_known(small: Path, tmp_path: Path) -> None:
    for words, message in (
        (["--bag", tmp_path], "not a bag: expected metadata.yaml, .mcap or .db3 files"),
        (["--experiment", small], "not a run record (JSONDecodeError"),
        (["--experiment", tmp_path / "none.json"], "cannot be read"),
        (["--experiment", small, "--bag", tmp_path], "--bag and --experiment: expected at most one of them"),
    ):
        refused(call("live", *words), message)


@pytest.mark.parametrize(("out", "reason"), [("small.yaml", "is a file"), ("small.yaml/x", "Not a directory")])
def test_a_place_where_no_bag_can_be_made(small: Path, out: str, reason: str) -> None:
    place = small.parent / out
    refused(call("run", small, "--out", place), f"error: --out: {place}: ", reason, "give a directory")
    assert list(small.parent.iterdir()) == [small]
    assert small.read_text() == yaml.safe_dump(document())


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    refused(call("run", tmp_path / "nowhere.yaml"), "nowhere.yaml")
    refused(call("run", tmp_path), str(tmp_path))
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    refused(call("run", tmp_path / "binary"), "binary")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["not a run record"]),
        ("[]", ["not a run record"]),
        ("{}", ["not a run record", "format"]),
        ('{"format": 99}', ["99", "expected 1"]),
        ("\x00", ["not a run record"]),
    ],
)
def test_malformed_run_record(tmp_path: Path, text: str, words: list[str]) -> None:
    (tmp_path / "run.json").write_text(text)
    refused(call("agent", "run.json", "--agent", "1"), "run.json", *words)


@pytest.mark.parametrize("command", [["switcher"], ["recorder", "--out", "bag"]], ids=" ".join)
def test_no_run_record(tmp_path: Path, command: list[str]) -> None:
    refused(call(command[0], "run.json", *command[1:]), "run.json")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"run": "not-a-uuid"}, "UUID"),
        ({"start": [[1.0], [2.0]]}, "shape (2, 1), expected finite numbers of shape (3, 1)"),
        ({"start": [[1.0], [2.0], [float("nan")]]}, "finite"),
        ({"start": [[1.0], [2.0], [3.0, 4.0]]}, "run.json"),
        ({"experiment": {}}, "name"),
        ({"versions": None}, "run.json"),
    ],
    ids=str,
)
def test_damaged_run_record(tmp_path: Path, run_file: Path, change: dict[str, Any], word: str) -> None:
    run_file.write_text(json.dumps(json.loads(run_file.read_text()) | change))
    refused(call("agent", run_file, "--agent", "1"), "run.json", word)


@pytest.mark.parametrize("value", ["232", "lab", "-1", "1.5"])
@pytest.mark.parametrize("command", [["live"], ["switcher", "run.json"]], ids=" ".join)
def test_no_domain(run_file: Path, command: list[str], value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """232 is the last that ROS knows, with ports for half of a large run; the middleware fails without saying why."""
    monkeypatch.setenv("ROS_DOMAIN_ID", value)
    refused(call(*command), f"ROS_DOMAIN_ID: {value}: expected a number from 0 to 231")


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (["4"], ["--agent: 4", "1 to 3"]),
        (["0"], ["--agent: 0"]),
        (["-1"], ["--agent: -1"]),
        (["1", "2", "1"], ["each agent once"]),
        (["one"], ["--agent", "one"]),
        ([], ["--agent"]),
    ],
)
def test_unknown_agents(run_file: Path, numbers: list[str], words: list[str]) -> None:
    options = [part for number in numbers for part in ("--agent", number)]
    refused(call("agent", run_file, *options), *words)


def test_the_recorder_never_overwrites(tmp_path: Path, run_file: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "mine").write_text("mine")
    program = Path(sys.executable).with_name("msg-agents")  # a node needs streams that have numbers
    command = [program, "recorder", run_file, "--out", tmp_path / "bag"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert "exists already" in done.stderr
    assert [file.name for file in (tmp_path / "bag").iterdir()] == ["mine"]


def test_check(tmp_path: Path) -> None:
    twin = simulate(Experiment.parse(document()))
    write_trajectory(twin, tmp_path / "runs" / "good")
    process = call("check")  # finds the newest one below ./runs
    assert (process.exit_code, process.stderr) == (0, "")
    assert "equal to the twin to the last bit: 303 states" in process.stdout

    states = twin.states.copy()
    states[40, 1] += 1e-12
    write_trajectory(dataclasses.replace(twin, states=states), tmp_path / "bad")
    process = call("check", tmp_path / "bad")
    assert process.exit_code == 1
    assert "first: agent 2 at step 40" in process.stdout
    process = call("check", tmp_path / "bad", "--json")
    assert process.exit_code == 1
    found = json.loads(process.stdout)
    assert (found["equal"], found["compared"], found["missing"]) == (False, 303, 0)

    states[50:] = np.nan
    write_trajectory(dataclasses.replace(twin, states=states), tmp_path / "wrong_and_torn")
    assert call("check", tmp_path / "wrong_and_torn").exit_code == 1
    states[40, 1] = twin.states[40, 1]
    write_trajectory(dataclasses.replace(twin, states=states), tmp_path / "torn")
    process = call("check", tmp_path / "torn")
    assert process.exit_code == 3
    assert "150 states, 153 missing" in process.stdout


def test_check_without_a_bag(tmp_path: Path) -> None:
    refused(call("check"), "runs")
    refused(call("check", tmp_path / "nowhere"), "nowhere")
    refused(call("check", tmp_path), str(tmp_path))
    (tmp_path / "text.mcap").write_text("no bag at all")
    refused(call("check", tmp_path / "text.mcap"), "text.mcap")


def test_prepare(small: Path) -> None:
    process = call("prepare", small)
    assert (process.exit_code, process.stderr) == (0, "")
    record = json.loads(process.stdout)
    assert uuid.UUID(record["run"]).version == 4
    assert Experiment.parse(record["experiment"]) == Experiment.parse(document())
    assert np.array_equal(record["start"], simulate(Experiment.parse(document())).states[0])
