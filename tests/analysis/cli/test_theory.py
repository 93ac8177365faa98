"""The commands transient, facts, plan and spectrum: what is printed where, and what is refused."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from msg_analysis import Experiment, Run, read_bag
from msg_analysis.cli import main as cli
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict

GOLDEN = Path(__file__).parents[2] / "data/golden"
LINE_RING = str(GOLDEN / "line_ring.yaml")


def call(*arguments):
    return CliRunner().invoke(cli.main, [str(argument) for argument in arguments])


def document_of(*arguments):
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture
def from_zero(tmp_path):
    """The line and the ring, started at zero."""
    file = tmp_path / "zero.yaml"
    file.write_text(Path(LINE_RING).read_text().replace("seed: 7", "seed: 7, start: zero"))
    return str(file)


def test_transient_tends_to_the_prediction(from_zero):
    prediction = predict(Experiment.load(from_zero))
    for law, moments in {"emulated": prediction.emulated, "continuous": prediction.continuous_moments}.items():
        document = document_of("transient", from_zero, "--times", "0:50:0.5", "--law", law)
        assert document["law"] == law
        assert document["times"] == pytest.approx(np.arange(0.0, 50.1, 0.5).tolist())
        assert document["system_error"][0] == 0.0
        assert document["system_error"][-1] == pytest.approx(moments.system_error, rel=1e-12)
        assert document["node_errors"][-1] == pytest.approx(moments.node_errors.tolist())
        assert document["steady_system_error"] == pytest.approx(moments.system_error)
        assert document["graph_law"] == [pytest.approx([0.5, 0.5])] * 101
        assert document["settling"]["from_start"] == document["settling"]["from_zero"]
        assert 1.7 < document["settling"]["from_zero"] < 2.0
        assert document["rates"]["graph"] == pytest.approx(1.0)
        assert "mode_means" not in document


def test_transient_with_moments_and_unreduced():
    document = document_of("transient", LINE_RING, "--times", "0,1", "--moments")
    second = np.array(document["mode_second_moments"])
    assert second.shape == (2, 2, 5, 5)
    assert np.trace(second[0].sum(axis=0)) == pytest.approx(document["system_error"][0])
    assert np.array(document["mode_means"]).shape == (2, 2, 5)
    for law in ("emulated", "continuous"):
        reduced = document_of("transient", LINE_RING, "--times", "0,1,100", "--law", law)
        grown = document_of("transient", LINE_RING, "--times", "0,1,100", "--law", law, "--unreduced")
        assert "system_error" not in grown
        # The agents' mean is a random walk of variance t / m, and is uncorrelated with what they disagree.
        expected = np.add(reduced["system_error"], [0.0, 1.0, 100.0])
        assert grown["system_second_moment"] == pytest.approx(expected.tolist(), rel=1e-10)


def test_transient_tables(tmp_path, from_zero):
    file = tmp_path / "table.csv"
    result = call("transient", from_zero, "--times", "0:5:1", "--csv", file)
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
    file = tmp_path / "quiet.yaml"
    file.write_text(
        Path(LINE_RING).read_text().replace("process: 1.0", "process: 0.0").replace("seed: 7", "start: zero")
    )
    document = document_of("transient", str(file), "--times", "0,1")
    assert document["settling"] == {"fraction": 0.05, "from_start": None, "from_zero": None}
    assert document["system_error"] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("file", "options", "message"),
    [
        ("line_ring", ["--times", "soon"], "expected START:STOP:STEP"),
        ("line_ring", ["--times", "0:1"], "expected START:STOP:STEP"),
        ("line_ring", ["--times", "1:0:0.5"], "expected START:STOP:STEP"),
        ("line_ring", ["--times", "0,nan"], "expected START:STOP:STEP"),
        ("line_ring", ["--times", "2,1"], "ascending"),
        ("line_ring", ["--times", "0.51"], "0.51 is not a multiple of the step 0.05"),
        ("line_ring", ["--times", "1", "--fraction", "2"], "settling fraction"),
        ("line_ring", ["--times", "1", "--csv", "/nowhere/file.csv"], "no such directory /nowhere"),
        ("air", ["--times", "1", "--law", "continuous"], "belong to steps"),
        ("discrete", ["--times", "1", "--law", "continuous"], "expected an experiment in continuous time"),
        ("tracking", ["--times", "1", "--unreduced"], "tracking has no reduction"),
    ],
)
def test_transient_refuses(file, options, message):
    result = call("transient", GOLDEN / f"{file}.yaml", *options)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stdout == ""


def test_facts_of_a_large_network(tmp_path):
    """The lemmas are left out, with the reason; what scales is there."""
    file = tmp_path / "large.yaml"
    labels = str(list(range(1, 41)))
    text = Path(LINE_RING).read_text().replace("[1, 2, 3, 4, 5]", labels)
    file.write_text(text)
    document = document_of("facts", file)
    assert document["facts"] is None
    assert "3200 rows" in document["notes"][0]
    assert document["bounds"]["lower"] < document["two_topology"]["continuous"]["system"]["error"]
    assert len(document["graphs"][0]["information_centrality"]) == 40
    assert "3200" in call("facts", file).stdout


@pytest.mark.parametrize("name", ["line_ring", "discrete", "tracking", "air"])
def test_facts(name):
    document = document_of("facts", GOLDEN / f"{name}.yaml")
    assert all(fact["holds"] for fact in document["facts"])
    assert set(document) == {"names", "modes", "facts", "bounds", "graphs", "two_topology", "notes"}
    prediction = predict(Experiment.load(GOLDEN / f"{name}.yaml"))
    if name in ("line_ring", "discrete"):
        law = "emulated" if name == "line_ring" else "discrete"
        form = document["two_topology"][law]
        assert form["system"]["error"] == pytest.approx(prediction.emulated.system_error, rel=1e-11)
        assert form["nodes"]["error"] == pytest.approx(prediction.emulated.node_errors.tolist(), rel=1e-11)
        assert document["bounds"]["upper"] is not None
    else:
        assert document["two_topology"] is None
        assert document["bounds"]["upper"] is None
    result = call("facts", GOLDEN / f"{name}.yaml")
    assert result.exit_code == 0
    assert "does not hold" not in result.stdout
    assert ("Two graphs in closed form" in result.stdout) == (document["two_topology"] is not None)


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


def test_plan_of_a_start(from_zero):
    text = " ".join(call("plan", from_zero, "--budget", "10ms", "--speed", "1").stderr.split())
    assert text.startswith("error: --budget 10ms: expected a number above 0 with s, min, h or d")
    text = " ".join(call("plan", from_zero, "--budget", "1s", "--speed", "20").stdout.split())
    assert "warm-up" in text
    assert "ends before the effect of the start does" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--precision", "much"], "--precision much: expected a share above 0, below 1: for example 1% or 0.01"),
        (["--precision", "150%"], "--precision 150%: expected a share"),
        (["--budget", "soon", "--speed", "9"], "--budget soon: expected a number above 0 with s, min, h or d"),
        (["--budget", "1h"], "give its speed in steps per second too"),
        (["--speed", "-3"], "speed: -3 steps per second: expected a number above 0"),
    ],
)
def test_plan_refuses(options, message):
    result = call("plan", LINE_RING, *options)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stdout == ""


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A run of the line and the ring."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    Experiment.load(LINE_RING).with_run(duration=100, seed=4).simulate().save(directory)
    return directory


def test_spectrum_of_an_experiment(tmp_path):
    document = document_of("spectrum", LINE_RING)
    assert document["system_autocovariance"][0] == pytest.approx(document["system_error"])
    assert [len(row) for row in document["node_autocovariances"]] == [5] * len(document["lags"])
    assert [len(row) for row in document["node_densities"]] == [5] * len(document["frequencies"])
    assert document["log"] is document["log_density"] is document["agrees"] is document["level"] is None
    text = call("spectrum", LINE_RING, "--figure", tmp_path / "figure.svg").stdout
    assert "Autocovariance of line_ring" in text
    assert "The log" not in text
    assert (tmp_path / "figure.svg").read_text().startswith("<?xml")


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
    text = call("spectrum", bag, "--figure", tmp_path / "figure.png").stdout
    assert "The log agrees with the predicted autocovariance: p = " in text
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_spectrum_of_a_wrong_run(bag, tmp_path):
    """States that are 10 % too large: exit code 1."""
    run = read_bag(bag)
    wrong = tmp_path / "wrong"
    Run.of(dataclasses.replace(run, states=1.1 * run.states)).save(wrong)
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
    Run.of(dataclasses.replace(states, states=broken)).save(tmp_path / "torn")
    result = call("spectrum", tmp_path / "torn", "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["log"]["steps"] == 149
    assert run.completeness.complete


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--figure", "picture.gif"], "picture.gif: expected a name that ends with .png, .svg or .pdf"),
        (["--figure", "/nowhere/a.png"], "no such directory /nowhere"),
    ],
)
def test_spectrum_refuses(options, message):
    result = call("spectrum", LINE_RING, *options)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stdout == ""
