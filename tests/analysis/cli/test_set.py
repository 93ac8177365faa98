"""``--set KEY=VALUE`` of the commands that take an experiment."""

import json
from pathlib import Path

import pytest
from programs import run


def system_error(*changes: str) -> float:
    words = [word for change in changes for word in ("--set", change)]
    result = run("msg-analysis", "predict", "line_ring", "--json", *words)
    assert result.exit_code == 0, result.stderr
    return float(json.loads(result.stdout)["emulated"]["system_error"])


def test_values_of_the_experiment_are_replaced() -> None:
    """The error is proportional to the square of the gain of the noise; the last of several values counts."""
    assert system_error("noise.process=2") == pytest.approx(4 * system_error())
    assert system_error("noise.process=5", "noise.process=2") == system_error("noise.process=2")
    assert system_error("noise.process=[1, 1, 1, 1, 1]", "noise.process[3]=2") > system_error()
    assert system_error("switching.scale=100") != system_error()


@pytest.mark.parametrize(
    "words",
    [
        ["plan", "--json"],
        ["leaders", "--count", "1", "--json"],
        ["spectrum", "--json"],
        ["simulate", "--json", "--out", "twin"],
    ],
    ids=lambda words: words[0],
)
def test_every_such_command_takes_it(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    command, *options = words
    given = run("msg-analysis", command, "line_ring", "--set", "name=other", "--set", "run.duration=10", *options)
    assert given.exit_code == 0, given.stderr
    assert json.loads(given.stdout)["experiment"] == "other"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("noise.proces=2", "line_ring.yaml --set noise.proces=2: noise.proces: unknown key"),
        ("noise.process", "--set noise.process: expected KEY=VALUE, for example noise.process=2"),
        ("=2", "--set =2: expected KEY=VALUE"),
        ("noise.process=", "--set noise.process=: expected KEY=VALUE"),
        ("noise.process[9]=2", "--set noise.process[9]: noise.process has 1.0: expected a list"),
        ("run.dt=[1", "--set run.dt=[1: line 2, column 1"),
    ],
)
@pytest.mark.parametrize(("program", "command"), [("msg-analysis", "predict"), ("msg-agents", "run")])
def test_refused(program: str, command: str, change: str, words: str) -> None:
    result = run(program, command, "line_ring", "--set", change)
    assert (result.exit_code, result.stdout) == (2, "")
    assert words in result.stderr


def test_not_with_a_bag(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").touch()
    result = run("msg-analysis", "spectrum", tmp_path, "--set", "noise.process=2")
    assert result.exit_code == 2
    assert "--set: not with the bag" in result.stderr


def test_an_example_that_is_meant() -> None:
    assert run("msg-agents", "examples", "discret").stderr.rstrip().endswith(": did you mean discrete?")
