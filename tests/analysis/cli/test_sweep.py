"""The command: files, texts, exit codes; interrupted and resumed. Real workers."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet
import pytest
import yaml
from programs import run
from waiting import wait_for

from experiments import Experiment, compare, predict, simulate
from msg_analysis.sweeps.workers import ENDING

Call = Callable[..., tuple[int, str, str]]
PROGRAM = Path(sys.executable).with_name("msg-analysis")
EXPERIMENT: dict[str, Any] = {
    "name": "two",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "switching": {"rates": {"line": {"ring": 1.0}, "ring": {"line": 1.0}}},
    "run": {"dt": 0.05, "duration": 50},
}


def file(directory: Path, **sweep: Any) -> Path:
    path = directory / "rates.yaml"
    path.write_text(yaml.safe_dump({"experiment": EXPERIMENT, **sweep}, sort_keys=False))
    return path


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [PROGRAM, "sweep", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"},
    )


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[Call]:
    """The command in this process, in which the server that forks the workers stays."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    before = {number: signal.getsignal(number) for number in ENDING}

    def invoke(*arguments: str | Path) -> tuple[int, str, str]:
        result = run("msg-analysis", "sweep", *arguments)
        return result.exit_code, result.stdout, result.stderr

    yield invoke
    for number, handler in before.items():
        signal.signal(number, handler)


def test_tables_hold_what_theory_says_and_nothing_is_done_again(tmp_path: Path, here: Call) -> None:
    over = {"switching.scale": {"from": 0.1, "to": 10, "count": 5, "spacing": "log"}, "run.dt": [0.05, 0.1]}
    path, out = file(tmp_path, over=over), tmp_path / "out"
    code, stdout, stderr = here(path, "--out", out, "--json")
    assert code == 0, stderr
    document = json.loads(stdout)
    assert (document["done"], document["failed"], document["kept"], document["verdict"]) == (10, 0, 0, None)
    names = ["results.parquet", "results.csv", "results.json", "figure.svg", "figure.png", "sweep.html"]
    assert [Path(name).name for name in document["files"]] == names
    with (out / "results.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert pyarrow.parquet.read_table(out / "results.parquet").num_rows == 10
    columns = pyarrow.parquet.read_table(out / "results.parquet").to_pydict()
    for number, point in enumerate(document["points"]):
        switching = EXPERIMENT["switching"] | {"scale": point["switching.scale"]}
        expected = predict(Experiment.parse(EXPERIMENT | {"switching": switching})).continuous.system_error
        assert point["continuous.system_error"] == pytest.approx(expected, rel=1e-12)
        assert float(rows[number]["continuous.system_error"]) == point["continuous.system_error"]
        assert columns["continuous.system_error"][number] == point["continuous.system_error"]
        assert point["emulated.system_error"] > expected
    assert json.loads((out / "results.json").read_text())["points"] == document["points"]

    journal = (out / "points.jsonl").read_bytes()
    # A changed file: what is new is done, the rest kept.
    over["run.dt"] = [0.05, 0.1, 0.2]
    code, stdout, stderr = here(file(tmp_path, over=over), "--out", out, "--workers", "1")
    assert "15 predictions, 10 of them from an earlier sweep." in " ".join(stdout.split())
    assert (out / "points.jsonl").read_bytes().startswith(journal)


def test_interrupted_and_resumed_it_is_as_if_it_never_was(tmp_path: Path, here: Call) -> None:
    """Runs of a fixed seed: the same numbers to the last digit, and nothing computed twice."""
    over = {"switching.scale": {"from": 0.1, "to": 10, "count": 6, "spacing": "log"}}
    experiment = EXPERIMENT | {"run": {"dt": 0.05, "duration": 400}}
    path, out = file(tmp_path, experiment=experiment, kind="simulate", over=over), tmp_path / "out"
    journal = out / "points.jsonl"
    process = start(path, "--out", out)
    deadline = time.monotonic() + 60
    while not (journal.exists() and journal.read_bytes().count(b"\n") >= 2):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.3)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)  # the impatient user
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stdout == ""
    assert "Traceback" not in stderr
    before = journal.read_bytes()
    kept = before.count(b"\n")
    assert f"interrupted: {kept} of 6 points are kept" in stderr
    code, stdout, _ = here(path, "--out", out, "--json")
    document = json.loads(stdout)
    assert (code, document["kept"], document["done"], document["verdict"]) == (0, kept, 6, "agrees")
    assert journal.read_bytes().startswith(before)
    assert journal.read_bytes().count(b"\n") == 6
    for row in document["points"][::4]:
        switching = EXPERIMENT["switching"] | {"scale": row["switching.scale"]}
        run = experiment["run"] | {"seed": row["seed"]}
        measured = compare(simulate(Experiment.parse(experiment | {"switching": switching, "run": run})))
        assert row["system_error.measured"] == measured.system_error.measured


@pytest.mark.skipif(sys.platform != "linux", reason="this machine: no signal at the end of the parent")
def test_workers_of_a_killed_sweep_end(tmp_path: Path) -> None:
    """In the middle of a long run."""
    experiment = EXPERIMENT | {"run": {"dt": 0.05, "duration": 100_000}}
    sweep = file(tmp_path, experiment=experiment, kind="simulate", over={"run.replicas": [1]})
    process = start(sweep, "--out", tmp_path)
    try:
        wait_for(lambda: [each for each in psutil.Process(process.pid).children() if each.cpu_times().user > 0.2], 60)
        (worker,) = psutil.Process(process.pid).children()
    finally:
        process.kill()
        process.communicate()
    worker.wait(20)


def test_failures_are_told_and_the_exit_code_says_so(tmp_path: Path, here: Call) -> None:
    """With a delay, some steps are unstable, which only the prediction can find out."""
    experiment = EXPERIMENT | {"noise": {"delay": 3}, "run": {"duration": 55}}
    path = file(tmp_path, experiment=experiment, over={"run.dt": [0.05, 0.55]})
    code, stdout, stderr = here(path, "--out", tmp_path / "out", "--workers", "1")
    assert code == 3, stderr
    assert "point 2: no result: " in stdout
    assert "2 predictions; 1 without a result." in " ".join(stdout.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scheduler", "nonsense://1"], "--scheduler nonsense://1: "),
        (["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], "give one of them"),
        (["--out", "/proc/nothing"], "choose another place with --out"),
    ],
)
def test_bad_usage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: Call, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, stderr = here(file(tmp_path, over={"run.dt": [0.05]}), *arguments)
    assert code == 2
    assert words in stderr
    assert "Traceback" not in stderr


def test_without_msg_agents_networks_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from msg_analysis.errors import InputError
    from msg_analysis.sweeps import points

    monkeypatch.setattr(points.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="msg-agents: not found"):
        points.find_program()
    program = tmp_path / "msg-agents"
    program.write_text("#!/usr/bin/python3\n")
    with pytest.raises(InputError, match="there is no rclpy"):
        points.find_program()
