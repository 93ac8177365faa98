"""What goes to stdout and what to stderr, and what happens where stdout takes nothing: of every command.

The commands that join a ROS network print nothing or are looked at in tests/integration.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import many_commands
import pytest
from programs import COMMANDS, command_of, run, without_progress

from msg_analysis.experiment.experiment import Experiment

ROOT = Path(__file__).parents[2]
LINE_RING = ROOT / "tests/data/golden/line_ring.yaml"
NETWORK = {"run", "demo", "doctor", "play", "live", "markers", "agent", "external", "switcher", "recorder"}
OVERVIEWS = [(program, option) for program in ("msg-analysis", "msg-agents") for option in ("--help", "--version")]
NEW = "NEW"  # a name that is not there yet
SWEEP = ["sweep.yaml", "--workers", "1", "--out", "swept"]  # its results are kept for the next time
WORDS = {  # what each of the others is given
    ("msg-analysis", "predict"): ["EXPERIMENT"],
    ("msg-analysis", "plan"): ["EXPERIMENT"],
    ("msg-analysis", "spectrum"): ["BAG"],
    ("msg-analysis", "simulate"): ["EXPERIMENT", "--duration", "5", "--out", NEW],
    ("msg-analysis", "diff"): ["BAG", "BAG"],
    ("msg-analysis", "runs"): ["FOLDER"],
    ("msg-analysis", "leaders"): ["EXPERIMENT", "--count", "1"],
    ("msg-analysis", "figures"): ["2", "--out", NEW, "--format", "svg"],
    ("msg-analysis", "info"): ["EXPERIMENT"],
    ("msg-analysis", "salvage"): ["BAG", NEW],
    ("msg-analysis", "export"): ["BAG", "--csv", "--parquet", "--npz", "--out", NEW],
    ("msg-analysis", "compare"): ["BAG", "--verbose"],
    ("msg-analysis", "map"): ["TABLE", "--map", "MAP", "--check"],
    ("msg-analysis", "tabulate"): ["RESULT"],
    ("msg-analysis", "transient"): ["EXPERIMENT", "--times", "0,1"],
    ("msg-analysis", "facts"): ["EXPERIMENT"],
    ("msg-analysis", "schema"): [],
    ("msg-analysis", "sweep"): SWEEP,
    ("msg-agents", "examples"): [],
    ("msg-agents", "new"): [NEW, "--agents", "4"],
    ("msg-agents", "runs"): ["FOLDER"],
    ("msg-agents", "check"): ["BAG"],
    ("msg-agents", "prepare"): ["EXPERIMENT"],
    ("msg-agents", "host"): ["RECORD", "HOSTS", "--profile"],
}
QUICK = [command for command in WORDS if command[1] not in ("figures", "sweep")]  # they take seconds
JSON_ANYWAY = {("msg-analysis", "schema"), ("msg-agents", "prepare")}
COLOUR = re.compile(r"\x1b\[[0-9;]*(?<=[\[;])(3[0-7]|4[0-7]|9[0-7]|10[0-7]|38|48)[;m]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a bag, its comparison, its record and a hosts file."""
    folder = tmp_path_factory.mktemp("streams")
    made = Experiment.load(LINE_RING).with_run(duration=10, replicas=2, seed=3).simulate()
    made.save(folder / "bag")
    (folder / "result.json").write_text(json.dumps(made.compare().to_json()))
    (folder / "run.json").write_text(made.record.to_json())
    (folder / "hosts.yaml").write_text("hosts: {a: {address: 10.0.0.1, agents: [1, 2, 3, 4, 5]}}\nrecorder: a\n")
    (folder / "robots.csv").write_text("time,1,2,graph\n0,1,2,a\n1,2,1,a\n2,1,1,b\n")
    (folder / "map.yaml").write_text('agents: {1: {field: "1"}, 2: {field: "2"}}')
    (folder / "sweep.yaml").write_text(f"experiment: {LINE_RING}\nkind: predict\nover: {{run.dt: [0.05, 0.1]}}\n")
    return folder


def outcomes(folder: Path, *jobs: tuple[tuple[str, str], str]) -> Iterator[tuple[tuple[str, str], str, int, str, str]]:
    """Command, kind, exit code, stdout, stderr; a kind is "plain", "json", or what stdout is (many_commands)."""
    places = {"EXPERIMENT": LINE_RING, "BAG": "bag", "RESULT": "result.json", "RECORD": "run.json"}
    places |= {"TABLE": "robots.csv", "MAP": "map.yaml", "HOSTS": "hosts.yaml", "FOLDER": "."}
    lines = []
    for (program, name), kind in jobs:
        words = [str(places.get(word, word)) for word in WORDS.get((program, name), [])]
        words = [uuid.uuid4().hex if word == NEW else word for word in words]
        words += ["--json"] * (kind == "json")
        lines.append([program, [name, *words], "pipe" if kind in ("plain", "json") else kind])
    found = many_commands.outcomes(lines, folder, COLUMNS="80", NO_COLOR="1", TERM="xterm-256color")
    for (command, kind), outcome in zip(jobs, found, strict=True):
        yield (command, kind, *outcome)


def test_no_command_is_forgotten() -> None:
    assert {name for _, name in COMMANDS} == {name for _, name in WORDS} | NETWORK


@pytest.mark.timeout(400)
def test_results_go_to_stdout(folder: Path) -> None:
    """On a terminal in 80 columns, and without colours if NO_COLOR says so; nothing on stderr."""
    jobs = [(command, kind) for command in QUICK for kind in ("plain", "terminal")]
    for command, kind, code, stdout, stderr in outcomes(folder, *jobs):
        assert (code, stderr) == (0, ""), (command, kind)
        assert stdout.endswith("\n"), command
        assert not COLOUR.search(stdout), command
        widest = max(map(len, re.sub(r"\x1b\[[0-9;]*m", "", stdout).splitlines()))
        assert widest <= 80 or command in JSON_ANYWAY or kind == "plain", command


def test_sentences_are_not_wrapped_for_programs(folder: Path) -> None:
    ((_, _, _, piped, _),) = outcomes(folder, (("msg-analysis", "compare"), "plain"))
    ((_, _, _, shown, _),) = outcomes(folder, (("msg-analysis", "compare"), "terminal"))
    assert "1005 of 1005 states in 200 steps (10 units of time)" in piped.splitlines()
    (evidence,) = (line for line in piped.splitlines() if line.startswith("Sequential test: "))
    assert evidence.endswith(" Valid at any stopping time.")
    (order,) = (line for line in piped.splitlines() if line.startswith("Order, smallest"))
    assert order.endswith("(family-wise level 0.01).")
    for sentence in (evidence, order):
        assert sentence not in shown
        assert sentence in " ".join(re.sub(r"\x1b\[[0-9;]*m", "", shown).split())


def test_stdout_that_has_few_characters(folder: Path) -> None:
    """What it does not have is "?"; an error would lose the result."""
    words = (["tabulate", "result.json"], ["info", "bag"], ["sweep", *SWEEP])
    lines = [["msg-analysis", one, "ascii"] for one in words]
    found = many_commands.outcomes(lines, folder, COLUMNS="80")
    for (name, *_), (code, stdout, stderr) in zip(words, found, strict=True):
        assert (code, "Traceback" in stderr) == (0, False), stderr
        assert stdout.isascii()
        assert ("?" in stdout) == (name == "tabulate")


@pytest.mark.timeout(400)
def test_json_is_one_object_and_nothing_else(folder: Path) -> None:
    """Without numbers that JSON does not have."""
    having = [command for command in WORDS if any("--json" in option.opts for option in command_of(*command).params)]
    assert {*having, *JSON_ANYWAY, ("msg-agents", "host")} == {*WORDS}
    jobs = [(command, "json") for command in having if command != ("msg-agents", "host")]
    for command, _, code, stdout, stderr in outcomes(folder, *jobs, *((command, "plain") for command in JSON_ANYWAY)):
        assert (code, without_progress(stderr)) == (0, ""), command
        assert isinstance(json.loads(stdout, parse_constant=lambda word: pytest.fail(word)), dict), command
        assert stdout.count("\n") == 1 or command[1] == "schema", command


@pytest.mark.timeout(400)
def test_a_result_that_cannot_be_printed(folder: Path) -> None:
    """One line says so, exit code 2: not 1, a disagreement, nor 0. A reader that goes away is no error."""
    wanted = {"gone": (141, "", "")}
    for kind, reason in (("full", "No space left on device"), ("closed", "Bad file descriptor")):
        wanted[kind] = (2, "", f"error: stdout: {reason}: the result could not be written\n")
    jobs = [(command, kind) for command in [*QUICK, *OVERVIEWS] for kind in ("full", "closed", "gone")]
    for command, kind, code, stdout, stderr in outcomes(folder, *jobs):
        assert (code, stdout, stderr) == wanted[kind], (command, kind)


@pytest.mark.timeout(400)
def test_a_disk_that_is_full(folder: Path) -> None:
    """Files cannot grow: one line says which, exit code 2, no traceback."""
    writing = [(("msg-analysis", name), "limit") for name in ("simulate", "figures", "salvage", "export")]
    for command, _, code, *texts in outcomes(folder, *writing):
        assert code == 2, command
        assert re.fullmatch(r"error: .*File too large.*\n", "".join(texts)), (command, texts)


@pytest.mark.parametrize("option", ["--report", "--csv"])
def test_devices_are_not_replaced_by_files(option: str, tmp_path: Path) -> None:
    """A file is written beside its place and moved there: /dev/null would be one ever after."""
    Experiment.load(LINE_RING).simulate(duration=5).save(tmp_path / "bag")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    words = ["compare", tmp_path / "bag"] if option == "--report" else ["transient", LINE_RING, "--times", "0"]
    result = run("msg-analysis", *words, option, pipe)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "not a regular file" in result.stderr
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
