"""Completion: by the protocol that the script of bash speaks, and in a real bash. Other shells are click's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from programs import run

from experiments import line_ring
from msg_analysis.experiment.examples import names

BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory as users have them: experiments, results, a bag among others in runs/."""
    place = tmp_path_factory.mktemp("place")
    for name in ("line.yaml", "ring.yml", "result.json", "notes.txt", ".hidden.yaml"):
        (place / name).write_text("")
    made = line_ring(run={"duration": 1}).simulate()
    made.save(place / "runs" / "lab_1")
    made.save(place / "runs" / "lab_2")
    (place / "run.json").write_text(made.record.to_json())
    (place / "empty").mkdir()
    return place


@pytest.fixture
def folder(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where one is."""
    monkeypatch.chdir(place)
    return place


def complete(line: str) -> list[str]:
    """What a shell is answered at the end of a line."""
    program, *rest = line.split(" ")
    variable = f"_{program.replace('-', '_').upper()}_COMPLETE"
    result = run(program, **{variable: "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(rest))})
    assert (result.exit_code, result.stderr) == (0, ""), result
    return [each for each in result.stdout.splitlines() if each]


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("msg-analysis p", ["plan", "predict"]),
        ("msg-agents re", ["recorder"]),
        ("msg-analysis predict ", ["empty/", "line.yaml", "result.json", "ring.yml", "run.json", "runs/", *names()]),
        ("msg-analysis predict li", ["line.yaml", "line_ring", "line_ring_realtime"]),
        ("msg-analysis predict line.", ["line.yaml"]),
        ("msg-analysis predict .h", [".hidden.yaml"]),
        ("msg-analysis compare ", ["empty/", "runs/"]),
        ("msg-analysis compare ru", ["runs/", "runs/lab_1", "runs/lab_2"]),
        ("msg-analysis compare runs/lab_1 runs/", ["runs/lab_1", "runs/lab_2"]),
        ("msg-analysis compare runs/lab_1/", ["runs/lab_1/lab_1_0.mcap"]),
        ("msg-analysis compare nowhere/", []),
        ("msg-analysis info runs/lab_1", ["runs/lab_1"]),
        ("msg-analysis leaders line.yaml --me", ["--method"]),
        ("msg-analysis leaders line.yaml --method ", ["auto", "exhaustive", "greedy", "swap"]),
        ("msg-analysis figures ", ["1", "2", "3", "all"]),
        ("msg-agents run line.yaml --pace ", ["lockstep", "realtime"]),
        ("msg-agents run line.yaml --processes o", ["one_per_agent"]),
        ("msg-agents agent run.json --agent ", ["1", "2", "3"]),
        ("msg-agents agent line.yaml --agent ", []),
        ("msg-agents agent run.json --await ", ["recorder"]),
        ("msg-agents play runs/lab_1 --topics /agent_1", ["/agent_1/state"]),
        ("msg-agents play empty --topics /", []),
    ],
)
def test_complete(folder: Path, line: str, values: list[str]) -> None:
    assert complete(line) == [f"plain,{value}" for value in values]


def test_names_that_must_be_quoted_are_left_to_the_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("two words.yaml", "line.yaml"):
        (tmp_path / name).write_text("")
    assert complete("msg-analysis predict t") == ["file,t"]


def test_in_bash(folder: Path) -> None:
    """By the line that docs/commands.md has for ~/.bashrc, and the function that it defines."""
    bash = shutil.which("bash")
    if not bash:
        pytest.skip("no bash: install it")
    script = """
        eval "$(_MSG_AGENTS_COMPLETE=bash_source msg-agents)"
        eval "$(_MSG_ANALYSIS_COMPLETE=bash_source msg-analysis)"
        complete -p msg-agents msg-analysis
        compopt() { echo "compopt $*"; }
        try() {
            COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
            $(complete -p "$1" | sed 's/.* -F \\([^ ]*\\) .*/\\1/') "$1"
            echo "${COMPREPLY[*]}"
        }
        try msg-analysis compare ru
        try msg-agents ch
        try msg-agents run --pace r
    """
    environment = os.environ | {"PATH": f"{BIN}:{os.environ['PATH']}"}
    process = subprocess.run(
        [bash, "--norc", "-c", script], capture_output=True, text=True, cwd=folder, env=environment
    )
    assert process.stderr == ""
    assert process.stdout.splitlines() == [
        "complete -o nosort -F _msg_agents_completion msg-agents",
        "complete -o nosort -F _msg_analysis_completion msg-analysis",
        "runs/ runs/lab_1 runs/lab_2",
        "check",
        "realtime",
    ]
