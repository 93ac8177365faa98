"""``examples``, ``new`` and ``demo``: what they print, write, ask and refuse."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import yaml
from click.testing import Result
from programs import PROGRAMS, run
from terminal import Terminal

pytest.importorskip("rclpy")

from msg_analysis.experiment.examples import FOLDER, names, text_of
from msg_analysis.experiment.experiment import Experiment

PROGRAM = Path(sys.executable).with_name("msg-agents")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*words: str) -> Result:
    return run("msg-agents", *words, COLUMNS="200")


def test_examples() -> None:
    lines = [line.strip().split(maxsplit=1) for line in call("examples").stdout.splitlines()]
    assert [name for name, _ in lines] == names()
    assert ["slow_switching", "Neither graph connects the six agents; their union does"] in lines
    listed = json.loads(call("examples", "--json").stdout)["examples"]
    assert [[each["name"], each["shows"]] for each in listed] == lines
    assert call("examples", "tracking").stdout == text_of("tracking")
    assert json.loads(call("examples", "tracking", "--json").stdout)["text"] == text_of("tracking")
    assert json.loads(call("prepare", "tracking").stdout)["experiment"]["name"] == "tracking"
    for file in ("recorded_robots", "recorded_robots.csv"):
        Path(file).with_suffix(Path(file).suffix or ".yaml").write_text(call("examples", file).stdout)
    words = "recorded_robots reads recorded_robots.csv, which has to be beside it: msg-agents examples recorded_rob"
    assert words in call("examples", "recorded_robots").stderr
    assert Experiment.load("recorded_robots.yaml") == Experiment.load(FOLDER / "recorded_robots.yaml")
    wrong = call("examples", "trakcing")
    assert (wrong.exit_code, wrong.stdout) == (2, "")
    assert wrong.stderr.startswith("error: trakcing: no example of this name: expected one of discrete, ")


@pytest.mark.parametrize("command", ["run", "prepare"])
def test_an_experiment_that_is_not_there(command: str) -> None:
    wrong = call(command, "lin_ring")
    assert (wrong.exit_code, wrong.stdout) == (2, "")
    assert wrong.stderr.startswith(
        "error: lin_ring: no such file, and no example of this name: expected a file, or one"
    )
    assert "Traceback" not in wrong.stderr


def test_the_demo_has_the_options_of_run() -> None:
    given, demo = (PROGRAMS["msg-agents"].commands[name] for name in ("run", "demo"))
    assert type(given) is type(demo)
    assert demo.params == [each for each in given.params if each.name != "experiment"]
    assert any(isinstance(each, click.Option) and "--web" in each.opts for each in demo.params)
    wrong = call("demo", "--duration", "-1", "--no-fork")
    assert (wrong.exit_code, wrong.stdout) == (2, "")
    assert wrong.stderr.startswith("error: --duration: run.duration: -1.0: expected a number > 0")


def test_new_without_a_terminal(here: Path) -> None:
    """Defaults, and what to do next; a file is never replaced."""
    done = call("new")
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "network.yaml",
        "Next: msg-analysis predict network.yaml",
        "      msg-agents run network.yaml",
    ]
    before = (here / "network.yaml").read_bytes()
    again = call("new", "--agents", "7")
    assert (again.exit_code, again.stdout) == (2, "")
    assert again.stderr == "error: network.yaml: exists already: remove it, or choose another name\n"
    assert (here / "network.yaml").read_bytes() == before


def test_new_with_options(here: Path) -> None:
    words = ["--agents", "8", "--graph", "star", "--graph", "ring", "--time", "discrete", "--switching", "0.1"]
    done = call("new", "my lab.yaml", *words, "--noise", "2", "--loss", "0.2", "--leader", "3", "--duration", "70")
    assert "msg-agents run 'my lab.yaml'" in done.stdout
    document = yaml.safe_load((here / "my lab.yaml").read_text())
    assert document == {
        "name": "my_lab",
        "problem": "tracking",
        "time": "discrete",
        "agents": 8,
        "graphs": {"star": {"star": {"center": 1}}, "ring": {"cycle": [1, 2, 3, 4, 5, 6, 7, 8]}},
        "switching": {"transition": [[0.9, 0.1], [0.1, 0.9]], "initial": "stationary"},
        "noise": {"process": 2.0, "loss": 0.2},
        "leaders": {"agents": [3], "gain": 1.0, "reference": 0.0},
        "run": {"duration": 70, "replicas": 16, "seed": 1, "pace": "lockstep"},
    }
    assert json.loads(call("new", "b.yaml", "--json").stdout) == {"file": "b.yaml", "experiment": "b"}


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--agents", "2"], "--agents: 2: expected at least 3 for a ring: give more, or another --graph"),
        (["--leader", "6"], "--leader: 6: expected an agent from 1 to 5"),
        (["--time", "discrete", "--switching", "1"], "--switching: 1: expected a probability below 1 in discrete time"),
        (["--duration", "0.25"], "--duration: 0.25: expected a multiple of the step 0.1"),
        (["--duration", "0.01"], "--duration: 0.01: expected a multiple of the step 0.1"),
        (["--graph", "line", "--graph", "line"], "--graph: line: expected different graphs: remove one"),
        (["below/x.yaml"], "below/x.yaml: no such directory below: create it"),
    ],
)
def test_new_refuses(words: list[str], error: str, here: Path) -> None:
    wrong = call("new", *words)
    assert (wrong.exit_code, wrong.stdout, wrong.stderr) == (2, "", f"error: {error}\n")
    assert list(here.iterdir()) == []


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal(PROGRAM, "new", "lab.yaml", columns=200)
    yield terminal
    terminal.close()


def test_new_asks_on_a_terminal(terminal: Terminal, here: Path) -> None:
    """A wrong answer is asked again; Enter takes what is in brackets."""
    questions = [
        ("Agents [5]: ", "six"),
        ("'six' is not a valid integer range", "6"),
        ("Graphs, of line, ring, star, complete [line, ring]: ", "ring, wheel"),
        ("'wheel' is not one of 'line', 'ring', 'star', 'complete'", "ring star"),
        ("Time (continuous, discrete) [continuous]: ", ""),
        ("Jumps per unit of time [0.5]: ", "0.2"),
        ("Noise gain [1.0]: ", ""),
        ("Probability that a message is lost [0.0]: ", "0.1"),
        ("Leaders, numbers of agents [none]: ", "2"),
        ("Duration [200.0]: ", "100"),
    ]
    for question, answer in questions:
        terminal.wait_for(question)
        terminal.text = terminal.text.partition(question)[2]
        terminal.type(f"{answer}\n".encode())
    assert terminal.read_to_the_end() == 0
    assert "Next: msg-analysis predict lab.yaml" in terminal.text
    experiment = Experiment.load(here / "lab.yaml")
    found = (experiment.name, experiment.agents, experiment.problem, experiment.run.duration)
    assert found == ("lab", 6, "tracking", 100)
    assert [graph.name for graph in experiment.graph_list] == ["ring", "star"]
    assert experiment.chain.matrix.tolist() == [[-0.2, 0.2], [0.2, -0.2]]
