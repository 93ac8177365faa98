"""What goes to stdout and what to stderr, and what happens where stdout takes nothing: of every command.

The commands that join a ROS network print nothing or are looked at in tests/integration.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import many_commands
import pytest
from programs import COMMANDS, command_of

from msg_analysis.api import Experiment

ROOT = Path(__file__).parents[2]
LINE_RING = ROOT / "tests/data/golden/line_ring.yaml"
NETWORK = {"run", "play", "live", "markers", "agent", "switcher", "recorder"}
SLOW = {"figures"}  # seconds each
KINDS = {
    False: ("plain", "json", "full", "closed", "gone", "terminal", "limit"),
    True: ("json", "limit"),
}
OVERVIEWS = [(program, option) for program in ("msg-analysis", "msg-agents") for option in ("--help", "--version")]
NEW = "NEW"  # a name that is not there yet
WORDS = {  # what each of the others is given
    ("msg-analysis", "predict"): ["EXPERIMENT"],
    ("msg-analysis", "simulate"): ["EXPERIMENT", "--duration", "5", "--out", NEW],
    ("msg-analysis", "leaders"): ["EXPERIMENT", "--count", "1"],
    ("msg-analysis", "figures"): ["1", "--out", NEW, "--format", "svg"],
    ("msg-analysis", "info"): ["EXPERIMENT"],
    ("msg-analysis", "salvage"): ["BAG", NEW],
    ("msg-analysis", "compare"): ["BAG"],
    ("msg-analysis", "tabulate"): ["RESULT"],
    ("msg-analysis", "transient"): ["EXPERIMENT", "--times", "0,1"],
    ("msg-analysis", "facts"): ["EXPERIMENT"],
    ("msg-analysis", "schema"): [],
    ("msg-agents", "check"): ["BAG"],
    ("msg-agents", "prepare"): ["EXPERIMENT"],
    ("msg-agents", "host"): ["RECORD", "HOSTS", "--profile"],
}
QUICK = [command for command in WORDS if command[1] not in SLOW]
JSON_ANYWAY = {("msg-analysis", "schema"), ("msg-agents", "prepare")}
COLOUR = re.compile(r"\x1b\[[0-9;]*(?<=[\[;])(3[0-7]|4[0-7]|9[0-7]|10[0-7]|38|48)[;m]")


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[Any, ...], list[Any]]:
    """(program, name, "plain", "json", or what stdout is) -> exit code, stdout, stderr."""
    folder = tmp_path_factory.mktemp("streams")
    run = Experiment.load(LINE_RING).simulate(duration=50, seed=3)
    run.save(folder / "bag")
    (folder / "result.json").write_text(json.dumps(run.compare().to_json()))
    (folder / "run.json").write_text(run.record.to_json())
    (folder / "hosts.yaml").write_text("hosts: {a: {address: 10.0.0.1, agents: [1, 2, 3, 4, 5]}}\nrecorder: a\n")
    places = {
        "EXPERIMENT": LINE_RING,
        "BAG": "bag",
        "RESULT": "result.json",
        "RECORD": "run.json",
        "HOSTS": "hosts.yaml",
    }
    jobs, keys = [], []
    for (program, name), words in WORDS.items():
        for kind in KINDS[name in SLOW]:
            given = [str(places.get(word, word)) for word in words]
            given = [f"new_{len(jobs)}" if word == NEW else word for word in given]
            if kind == "json":
                given += ["--json"] * any("--json" in option.opts for option in command_of(program, name).params)
            jobs.append([program, [name, *given], "pipe" if kind in ("plain", "json") else kind])
            keys.append((program, name, kind))
    for program, option in OVERVIEWS:
        for kind in ("full", "closed", "gone"):
            jobs.append([program, [option], kind])
            keys.append((program, option, kind))
    environment = os.environ | {"COLUMNS": "80", "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1", "TERM": "xterm-256color"}
    process = subprocess.run(
        [sys.executable, "-W", "ignore", many_commands.__file__],
        input=json.dumps(jobs),
        capture_output=True,
        text=True,
        env=environment,
        cwd=folder,
        timeout=110,
    )
    assert process.returncode == 0, process.stderr
    return dict(zip(keys, json.loads(process.stdout), strict=True))


def test_no_command_is_forgotten() -> None:
    assert {name for _, name in COMMANDS} == {name for _, name in WORDS} | NETWORK


@pytest.mark.parametrize(("program", "name"), QUICK)
def test_results_go_to_stdout(outcomes: Any, program: str, name: str) -> None:
    code, stdout, stderr = outcomes[program, name, "plain"]
    assert (code, stderr) == (0, "")
    assert stdout.endswith("\n")
    if (program, name) not in JSON_ANYWAY:
        assert max(map(len, stdout.splitlines())) <= 80


@pytest.mark.parametrize(("program", "name"), [command for command in WORDS if command != ("msg-agents", "host")])
def test_json_is_one_object_and_nothing_else(outcomes: Any, program: str, name: str) -> None:
    code, stdout, stderr = outcomes[program, name, "json"]
    assert (code, stderr) == (0, "")
    assert isinstance(json.loads(stdout, parse_constant=lambda word: pytest.fail(word)), dict)
    assert stdout.count("\n") == 1 or name == "schema"


@pytest.mark.parametrize(("program", "name"), [*QUICK, *OVERVIEWS])
@pytest.mark.parametrize(("kind", "reason"), [("full", "No space left on device"), ("closed", "Bad file descriptor")])
def test_a_result_that_cannot_be_printed(outcomes: Any, program: str, name: str, kind: str, reason: str) -> None:
    """One line says so, exit code 2: not 1, which would be a disagreement, nor 0."""
    code, stdout, stderr = outcomes[program, name, kind]
    assert (code, stdout) == (2, "")
    assert stderr == f"error: stdout: {reason}: the result could not be written\n"


@pytest.mark.parametrize(("program", "name"), [*QUICK, *OVERVIEWS])
def test_a_reader_that_goes_away_is_no_error(outcomes: Any, program: str, name: str) -> None:
    assert outcomes[program, name, "gone"] == [141, "", ""]


@pytest.mark.parametrize(("program", "name"), QUICK)
def test_no_color(outcomes: Any, program: str, name: str) -> None:
    """On a terminal, with NO_COLOR."""
    code, stdout, stderr = outcomes[program, name, "terminal"]
    assert (code, stderr) == (0, "")
    assert not COLOUR.search(stdout)
    if (program, name) not in JSON_ANYWAY:
        assert max(map(len, re.sub(r"\x1b\[[0-9;]*m", "", stdout).splitlines())) <= 80


@pytest.mark.parametrize("name", ["simulate", "figures", "salvage"])
def test_a_disk_that_is_full(outcomes: Any, name: str) -> None:
    """Files cannot grow: one line says which, exit code 2, no traceback."""
    code, text, _ = outcomes["msg-analysis", name, "limit"]
    assert code == 2
    assert re.fullmatch(r"error: .*File too large.*\n", text), text


@pytest.mark.parametrize("option", ["--report", "--csv"])
def test_devices_are_not_replaced_by_files(option: str, tmp_path: Path) -> None:
    """A file is written beside its place and moved there: /dev/null would be one ever after."""
    from click.testing import CliRunner

    from msg_analysis.cli import main

    Experiment.load(LINE_RING).simulate(duration=5).save(tmp_path / "bag")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    words = ["compare", tmp_path / "bag"] if option == "--report" else ["transient", LINE_RING, "--times", "0"]
    result = CliRunner().invoke(main, [*map(str, words), option, str(pipe)])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "no regular file" in result.stderr
    assert pipe.is_fifo()


@pytest.mark.parametrize("program", ["msg-analysis", "msg-agents"])
def test_in_a_shell(program: str) -> None:
    """The same by a shell, in processes from their start to their end."""
    run = f"'{Path(sys.executable).with_name(program)}'"
    script = (
        f"{run} --help >&-; echo $?; {run} --help >/dev/full; echo $?; {run} --help | true; echo ${{PIPESTATUS[0]}}"
    )
    bash = shutil.which("bash")
    assert bash
    process = subprocess.run([bash, "-c", script], capture_output=True, text=True)
    *codes, piped = process.stdout.split()
    assert codes == ["2", "2"]
    assert piped in ("0", "141")  # a pipe takes some before it is closed
    assert process.stderr.splitlines() == [
        "error: stdout: Bad file descriptor: the result could not be written",
        "error: stdout: No space left on device: the result could not be written",
    ]
