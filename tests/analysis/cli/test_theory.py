"""The commands transient, facts, plan, spectrum, leaders and figures: what is printed where, and what is refused."""

import csv
import dataclasses
import functools
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from programs import call

from experiments import GOLDEN, Experiment
from msg_analysis import read_bag
from msg_analysis.cli import console
from msg_analysis.paper import examples

LINE_RING = str(GOLDEN / "line_ring.yaml")
FROM_ZERO = {"run": {"start": "zero"}}
NO_TIMES = ["soon", "0:1", "1:0:0.5", "0,nan"]


def document_of(*arguments):
    result = call(*arguments, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    return json.loads(result.stdout)


def written(directory, **changes):
    """A file of the line and the ring with other values of these keys."""
    file = directory / "file.yaml"
    file.write_text(json.dumps(Experiment.load(LINE_RING).to_document() | changes))
    return file


def test_transient_with_moments_and_unreduced():
    for law in ("emulated", "continuous"):
        reduced = document_of("transient", LINE_RING, "--times", "0,1,100", "--law", law, "--moments")
        second = np.array(reduced["mode_second_moments"])
        assert (second.shape, np.shape(reduced["mode_means"])) == ((3, 2, 5, 5), (3, 2, 5))
        assert np.trace(second[0].sum(axis=0)) == pytest.approx(reduced["system_error"][0])
        grown = document_of("transient", LINE_RING, "--times", "0,1,100", "--law", law, "--unreduced")
        assert "system_error" not in grown
        # The agents' mean is a random walk of variance t / m, and is uncorrelated with what they disagree.
        expected = np.add(reduced["system_error"], [0.0, 1.0, 100.0])
        assert grown["system_second_moment"] == pytest.approx(expected.tolist(), rel=1e-10)


def test_transient_tables(tmp_path):
    file = tmp_path / "table.csv"
    result = call("transient", written(tmp_path, **FROM_ZERO), "--times", "0:5:1", "--csv", file)
    assert result.exit_code == 0
    assert "from zero" in result.stdout
    with file.open() as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 6
    assert list(rows[0])[:3] == ["time", "probability of line", "probability of ring"]
    assert float(rows[0]["system error"]) == 0.0
    assert float(rows[5]["node error of agent 3"]) > 0.2
    assert list(tmp_path.glob("*.part")) == []


def test_without_noise_nothing_settles(tmp_path):
    document = document_of("transient", written(tmp_path, noise={"process": 0}, **FROM_ZERO), "--times", "0,1")
    assert document["settling"] == {"fraction": 0.05, "from_start": None, "from_zero": None}
    assert document["system_error"] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("command", "file", "options", "message"),
    [
        *[("transient", "line_ring", ["--times", times], "expected START:STOP:STEP") for times in NO_TIMES],
        ("transient", "line_ring", ["--times", "0.51"], "0.51 is not a multiple of the step 0.05"),
        ("transient", "line_ring", ["--times", "1", "--csv", "/nowhere/file.csv"], "no such directory /nowhere"),
        ("transient", "air", ["--times", "1", "--law", "continuous"], "belong to steps"),
        ("transient", "discrete", ["--times", "1", "--law", "continuous"], "expected an experiment in continuous time"),
        ("transient", "tracking", ["--times", "1", "--unreduced"], "tracking has no reduction"),
        ("plan", "line_ring", ["--precision", "much"], "--precision much: expected a share above 0, below 1"),
        ("plan", "line_ring", ["--precision", "150%"], "--precision 150%: expected a share"),
        ("plan", "line_ring", ["--budget", "soon", "--speed", "9"], "--budget soon: expected a number above 0 with s"),
        ("plan", "line_ring", ["--budget", "10ms", "--speed", "1"], "--budget 10ms: expected a number above 0 with s"),
        ("plan", "line_ring", ["--budget", "1h"], "give its speed in steps per second too"),
        ("spectrum", "line_ring", ["--figure", "a.gif"], "a.gif: expected a name that ends with .png, .svg"),
        ("spectrum", "line_ring", ["--figure", "/nowhere/a.png"], "no such directory /nowhere"),
        ("leaders", "line_ring", ["--count", "5"], "count 5: expected 1 to 4"),
        ("leaders", "line_ring", [], "has no leaders: give their number"),
    ],
)
def test_refused(command, file, options, message):
    result = call(command, GOLDEN / f"{file}.yaml", *options)
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in " ".join(result.stderr.split())


def test_facts_of_a_large_network(tmp_path):
    """The lemmas are left out, with the reason; what scales is there."""
    everybody = list(range(1, 41))
    file = written(tmp_path, agents=40, graphs={"line": {"path": everybody}, "ring": {"cycle": everybody}})
    document = document_of("facts", file)
    assert document["facts"] is None
    assert "3200 rows" in document["notes"][0]
    assert document["bounds"]["lower"] < document["two_topology"]["continuous"]["system"]["error"]
    assert len(document["graphs"][0]["information_centrality"]) == 40
    assert "3200" in call("facts", file).stdout


@pytest.mark.parametrize("name", ["line_ring", "discrete", "tracking", "air"])
def test_facts(name):
    """All hold; two graphs have a closed form with equal noise and no leader."""
    document, closed = document_of("facts", GOLDEN / f"{name}.yaml"), name in ("line_ring", "discrete")
    assert all(fact["holds"] for fact in document["facts"])
    assert (document["bounds"]["upper"] is not None) == (document["two_topology"] is not None) == closed
    text = call("facts", GOLDEN / f"{name}.yaml").stdout
    assert "does not hold" not in text
    assert ("Two graphs in closed form" in text) == closed


def test_plan(tmp_path):
    document = document_of("plan", LINE_RING, "--precision", "2 %", "--budget", "10min", "--speed", "800")
    assert document == document_of("plan", LINE_RING, "--precision", "0.02", "--budget", "600", "--speed", "800")
    assert document["precision"] == 0.02
    assert document["budget"]["steps"] == 480_000
    text = call("plan", LINE_RING, "--precision", "2%", "--budget", "1h", "--speed", "800").stdout
    assert text.startswith("For ± 2 % of the system error (95 %), run 56581 steps (1 min 11 s) with 16 replicas;")
    assert "Run length for ± 2 % (95 %): evaluated once at the end, or monitored throughout" in text
    assert "best run in 1 h 0 min" in text
    assert "noise variance of agent 1 x 1.05" in text
    assert "speed: gives" not in text
    assert "not known: --speed gives the wall time" in call("plan", LINE_RING).stdout


def test_plan_of_a_start():
    text = " ".join(
        call("plan", LINE_RING, "--set", "run.start=zero", "--budget", "1s", "--speed", "20").stdout.split()
    )
    assert "warm-up" in text
    assert "ends before the effect of the start does" in text


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A run of the line and the ring."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    Experiment.load(LINE_RING).with_run(duration=100, seed=4).simulate().save(directory)
    return directory


def test_spectrum_of_a_bag(bag, tmp_path):
    document = document_of("spectrum", bag)
    assert document["agrees"] is True
    log = document["log"]
    assert log["p"] > document["level"] == 0.01
    assert log["steps"] == 2000
    assert log["lags"][:2] == [0.0, 0.05]
    low, high = np.transpose(log["intervals"])
    assert (low < log["corrected"]).all()
    assert (high > log["corrected"]).all()
    assert len(document["log_density"]["frequencies"]) == len(document["log_density"]["system"])
    text = call("spectrum", LINE_RING, "--figure", tmp_path / "figure.svg").stdout
    assert "Autocovariance of line_ring" in text
    assert "The log" not in text
    assert (tmp_path / "figure.svg").read_text().startswith("<?xml")
    text = call("spectrum", bag, "--figure", tmp_path / "figure.png").stdout
    assert "The log agrees with the predicted autocovariance: p = " in text
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_spectrum_of_a_wrong_run(bag, tmp_path):
    """States that are 10 % too large: exit code 1."""
    run = read_bag(bag)
    wrong = tmp_path / "wrong"
    dataclasses.replace(run, states=1.1 * run.states).save(wrong)
    result = call("spectrum", wrong)
    assert result.exit_code == 1
    assert "The log disagrees with the predicted autocovariance" in result.stdout


def test_spectrum_of_runs_that_are_not_tested(tmp_path):
    Experiment.load("line_ring_realtime").with_run(duration=20).simulate().save(tmp_path / "real_time")
    document = document_of("spectrum", tmp_path / "real_time")
    assert document["log"] is None
    assert document["agrees"] is None
    assert document["note"] == "the log is not tested: in real time agents use values of different steps"
    assert document["log_density"] is not None
    run = read_bag(tmp_path / "real_time")
    states = Experiment.load(LINE_RING).with_run(duration=20).simulate()
    broken = states.states.copy()
    broken[150, 2] = np.nan
    dataclasses.replace(states, states=broken).save(tmp_path / "torn")
    result = call("spectrum", tmp_path / "torn", "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["log"]["steps"] == 149
    assert run.completeness.complete


@pytest.mark.parametrize("method", ["auto", "greedy"])
def test_leaders_json(method: str) -> None:
    """By every method, law and gain that is asked for: a held leader gives the least error."""
    document = document_of("leaders", LINE_RING, "--count", "2", "--method", method, "--top", "2")
    assert document["method"] == ("exhaustive" if method == "auto" else method)
    assert len(document["sets"]) == 2
    options = ([], ["--law", "emulated"], ["--gain", "0.5"])
    held, *others = (document_of("leaders", LINE_RING, "--count", "1", *more)["sets"][0] for more in options)
    assert all(other["system_error"] > held["system_error"] for other in others)


def test_leaders_of_the_file() -> None:
    """Their number and gain unless others are given, and what they achieve beside the best."""
    document = document_of("leaders", "tracking")
    assert (document["count"], document["gain"]) == (2, 0.7)
    predicted = Experiment.load("tracking").predict().continuous
    assert document["present"]["agents"] == [1, 4]
    assert document["present"]["system_error"] == pytest.approx(predicted.system_error, rel=1e-9)
    assert document["sets"][0]["system_error"] < document["present"]["system_error"]
    other = document_of("leaders", "tracking", "--count", "1", "--gain", "inf")
    assert (other["count"], other["gain"], other["present"]["agents"]) == (1, "inf", [1, 4])
    assert "leaders now: 1, 4" in call("leaders", "tracking").stdout
    assert document_of("leaders", LINE_RING, "--count", "1")["present"] is None


def test_leaders_text() -> None:
    result = call("leaders", LINE_RING, "--count", "2")
    assert (result.exit_code, result.stderr) == (0, "")
    for part in ("Sets of 2 leaders, held at the reference", "joint centrality", "1, 4", "no better set exists"):
        assert part in result.stdout
    swap = call("leaders", LINE_RING, "--count", "2", "--method", "swap", "--gain", "2").stdout
    assert "gain 2" in swap
    assert "% above the best" in " ".join(swap.split())
    assert "Single leaders" in call("leaders", LINE_RING, "--count", "1").stdout


def test_no_guarantee_says_why() -> None:
    gains = "[[1, 0, 0, 0, 0], [-1, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]"
    correlated = LINE_RING, "--set", f"noise.process={gains}", "--count", "2", "--method", "greedy"
    result = call("leaders", *correlated)
    assert result.exit_code == 0
    assert "none: the noise of some agents is negatively correlated" in " ".join(result.stdout.split())
    assert document_of("leaders", *correlated)["bound"] == {"system_error": None, "gap": None}


def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(0.0, 20.0).__next__
    monkeypatch.setattr(console, "SolveProgress", functools.partial(console.SolveProgress, clock=clock))
    result = call("leaders", LINE_RING, "--count", "2", "--method", "swap", "--json")
    assert json.loads(result.stdout)["sets"]
    assert "line_ring: greedy: 1 of 10, smallest system error" in result.stderr
    assert "\x1b" not in result.stderr


def test_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, example in list(examples.EXAMPLES.items()):
        monkeypatch.setitem(examples.EXAMPLES, number, functools.cache(functools.partial(example, 5)))
    result = call("figures", "--out", tmp_path / "all", "--format", "svg")
    assert (result.exit_code, result.stderr) == (0, "")
    names = [f"example_{number}.{kind}" for number in (1, 2, 3) for kind in ("svg", "csv")]
    assert result.stdout.splitlines() == [str(tmp_path / "all" / name) for name in names]
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == sorted(names)
    result = call("figures", "2", "--out", tmp_path / "one", "--format", "pdf", "--format", "pdf", "--format", "svg")
    assert sorted(path.suffix for path in (tmp_path / "one").iterdir()) == [".csv", ".pdf", ".svg"]
    (tmp_path / "file").touch()
    result = call("figures", "2", "--out", tmp_path / "file", "--format", "svg")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "choose another place with --out" in result.stderr
    assert call("figures", "4").exit_code == 2
