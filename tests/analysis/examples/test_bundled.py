"""The examples, and the rule by which commands find an experiment."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from pages import EXPERIMENTS

from msg_analysis import Experiment
from msg_analysis.cli.main import main
from msg_analysis.errors import InputError
from msg_analysis.experiment.examples import find, names, shows, text_of
from msg_analysis.sweep.grid import load_sweep

OWN = {"name": "own", "graphs": {"line": {"path": [1, 2]}}}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_example_says_what_it_shows_in_one_line() -> None:
    assert names() == sorted(file.stem for file in EXPERIMENTS.iterdir())
    for name in names():
        assert 20 < len(shows(name)) < 120
        assert yaml.safe_load(text_of(name))["name"] == name
    assert shows("fast_switching") == "The network of slow_switching.yaml, switching a hundred times as fast"


def test_a_name_is_an_example(here: Path) -> None:
    (here / "line_ring").mkdir()  # a directory is no file of that name
    assert find("line_ring") == EXPERIMENTS / "line_ring.yaml"


@pytest.mark.parametrize("file", ["line_ring", "line_ring.yaml"])
def test_a_file_of_that_name_wins(file: str, here: Path) -> None:
    (here / file).write_text(yaml.safe_dump(OWN))
    assert find("line_ring") == find(Path("line_ring")) == Path(file)
    assert Experiment.load("line_ring").name == "own"
    assert find("line_ring", EXPERIMENTS.parent) == EXPERIMENTS / "line_ring.yaml"  # there is no such file there


@pytest.mark.parametrize("path", ["./line_ring", "nowhere/line_ring", "/line_ring", "other.yaml", "line_ring.json"])
def test_a_path_is_no_example(path: str) -> None:
    assert find(path) == Path(path)


def test_neither_file_nor_example() -> None:
    with pytest.raises(InputError) as error:
        find("lin_ring")
    assert str(error.value) == (
        f"lin_ring: no such file, and no example of this name: expected a file, or one of {', '.join(names())}"
        ": did you mean line_ring?"
    )
    with pytest.raises(InputError, match=r"^line_ring\.yaml: no such file: check the path, or give line_ring"):
        find("line_ring.yaml")
    with pytest.raises(InputError, match=r"^lin_ring: no example of this name: expected one of discrete, "):
        text_of("lin_ring")


@pytest.mark.parametrize(
    "command", ["predict", "simulate", "leaders --count 1", "transient --times 1", "facts", "plan", "spectrum"]
)
def test_commands_of_the_analysis(command: str) -> None:
    word, *options = command.split()
    result = CliRunner().invoke(main, [word, "discrete", *options, "--json"])
    assert result.exit_code == 0, result.output
    assert "discrete" in json.dumps(json.loads(result.stdout))
    result = CliRunner().invoke(main, [word, "discreet", *options])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: discreet: no such file, and no example of this name: expected a file, or")


def test_info_takes_both(here: Path) -> None:
    """A bag of that name wins, too; any other directory does not."""
    run = CliRunner()
    (here / "discrete").mkdir()
    assert json.loads(run.invoke(main, ["info", "discrete", "--json"]).stdout)["name"] == "discrete"
    (here / "discrete").rmdir()
    Experiment.parse(OWN | {"run": {"duration": 1, "start": "zero"}}).simulate().save(here / "discrete")
    assert json.loads(run.invoke(main, ["info", "discrete", "--json"]).stdout)["experiment"] == "own"


def test_a_sweep_of_an_example(here: Path) -> None:
    """The directory that counts is that of the sweep file."""
    below = here / "below"
    below.mkdir()
    sweep = below / "sweep.yaml"
    sweep.write_text(yaml.safe_dump({"experiment": "line_ring", "over": {"switching.scale": [1.0]}}))
    (here / "line_ring.yaml").write_text(yaml.safe_dump(OWN))
    assert load_sweep(sweep).experiment == "line_ring"
    (below / "line_ring.yaml").write_text(yaml.safe_dump(OWN | {"switching": {"rates": {}}}))
    assert load_sweep(sweep).experiment == "own"
