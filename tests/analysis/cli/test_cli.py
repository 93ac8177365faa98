"""The command line: what is printed where, and the exit codes."""

import json
import math
from pathlib import Path

import pytest
from programs import call

from experiments import golden, simulate, write_trajectory
from msg_analysis.bags.stored_file import Storage
from msg_analysis.experiment import experiment as experiments

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests/data/golden"
LINE_RING = str(GOLDEN / "line_ring.yaml")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("bags") / "twin"
    result = call("simulate", LINE_RING, "--duration", "50", "--seed", "3", "--out", directory)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{directory}\n"
    return directory


@pytest.mark.parametrize(
    ("command", "file", "words"),
    [
        ("compare", LINE_RING, f"is an experiment file: expected a bag: `msg-agents run {LINE_RING}` and"),
        ("predict", "", "is a bag: expected a YAML file: give the experiment file from which it was recorded"),
        ("predict", "twin_0.mcap", "is a bag: expected a YAML file"),
        ("predict", "metadata.yaml", "is the metadata of a bag: expected a YAML file"),
        ("compare", "metadata.yaml", "is the metadata of a bag: expected a bag: give its directory, "),
        ("sweep", "", "is a bag: expected a YAML file"),
        ("sweep", LINE_RING, "is an experiment file: expected a sweep file"),
        ("predict", "sweep.yaml", "is a sweep file: expected an experiment file"),
        ("compare", "sweep.yaml", "is a sweep file: expected a bag"),
    ],
)
def test_a_file_of_another_kind(command: str, file: str, words: str, bag: Path, tmp_path: Path) -> None:
    """One line says what it is and what to do."""
    path = tmp_path / file if file == "sweep.yaml" else bag / file
    if file == "sweep.yaml":
        path.write_text("experiment: line_ring.yaml\nover: {run.seed: [1, 2]}\n")
    result = call(command, path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {path}: {words}".removesuffix("/"))
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["predict", "info"])
def test_notes_on_files_with_graphs(command: str, tmp_path: Path) -> None:
    """On stderr, and in the JSON."""
    (tmp_path / "net.csv").write_text("source,target,cost\n1,2,3\n")
    (tmp_path / "net.yaml").write_text("name: net\ngraphs: {net: {csv: net.csv}}\n")
    result = call(command, tmp_path / "net.yaml", "--json")
    note = "graphs.net.csv: no `weight`, so every link has 1; not read: cost"
    assert result.stderr == f"note: {note}\n"
    assert json.loads(result.stdout)["notes"] == [note]


@pytest.mark.parametrize("command", ["predict", "simulate", "info"])
def test_bad_files_are_errors_of_the_user(command: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("name: bad\ngraphs: {line: {path: [1, 2]}}\nrun: {dt: 0, sed: 1}\n")
    result = call(command, file)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"error: {file}: 2 problems\n")
    assert "did you mean 'seed'?" in result.stderr


def test_predict_samples() -> None:
    """Where it is asked to, and where the exact prediction is too large: ten channels with bursts."""
    named = call("predict", LINE_RING, "--precision", "5 %", "--agents", "1,3", "--seed", "2", "--json")
    law = json.loads(named.stdout)["emulated"]
    low, high = law["interval"]
    assert (law["method"], law["seed"], low < law["system_error"] < high) == ("sampled", 2, True)
    assert [error is None for error in law["node_errors"]] == [False, True, False, True, True]
    large = ("--set", "noise.loss=0.2", "--set", "noise.burst=5")
    text = call("predict", LINE_RING, *large, "--within", "2s").stdout
    assert "sampled" in text
    assert text.count(" .. ") == 6
    for words, error in (
        (("--precision", "2"), "--precision 2: expected a share above 0, below 1"),
        (("--within", "soon"), "--within soon: expected a number above 0 with s, min, h or d"),
        (("--agents", "1,9"), "agents: 9: expected numbers from 1 to 5"),
        (("--agents", "1,²"), 'agents: "²": expected numbers from 1 to 5'),
        (("--workers", "2", "--scheduler", "tcp://10.0.0.1:8786"), "--workers: not together with --scheduler"),
        (("--from", "3", "--seed", "1"), "--from 3: expected with a schedule"),
    ):
        refused = call("predict", LINE_RING, *words)
        assert (refused.exit_code, refused.stderr.startswith(f"error: {error}")) == (2, True)


def test_real_time_is_predicted_in_turn() -> None:
    assert "sequential steps" in call("predict", LINE_RING, "--set", "run.pace=realtime").stdout
    for pace, law in (("realtime", "sequential"), ("lockstep", "synchronous")):
        result = call("predict", LINE_RING, "--set", f"run.pace={pace}", "--json")
        assert json.loads(result.stdout)["emulated"]["law"] == law


def test_simulate_names_the_bag_after_the_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("simulate", LINE_RING, "--duration", "1").stdout == "line_ring_twin\n"
    assert (tmp_path / "line_ring_twin/metadata.yaml").is_file()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--duration", "0.01"], "run.duration: 0.01: expected a whole number of steps"),
        (["--seed", "x"], "'x' is not a valid integer"),
        (["--compression", "zip"], "compression"),
        (["--split-size", "0"], "split-size"),
        (["--split-size", "nan"], "split-size"),
    ],
)
def test_simulate_checks_its_options(options: list[str], expected: str, tmp_path: Path) -> None:
    result = call("simulate", LINE_RING, "--out", tmp_path / "bag", *options)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_compare(bag: Path) -> None:
    """The seed is fixed; a fresh one would disagree with probability 0.01 (level of the family of tests)."""
    result = call("compare", bag, "--json")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["verdict"], document["steps"]) == (0, "agrees", 1000)
    table = call("compare", bag)
    assert table.exit_code == 0
    assert table.stdout.startswith("The run agrees with the prediction.")
    nowhere = call("compare", bag, "--report", bag / "nowhere/report.html")
    assert nowhere.exit_code == 2
    assert "no such directory" in nowhere.stderr


def test_info(bag: Path) -> None:
    """Of an experiment and of a bag."""
    result = call("info", LINE_RING, "--json")
    document = json.loads(result.stdout)
    assert result.exit_code == 0
    assert document["stability_limit"] == pytest.approx(2 / (2 - 2 * math.cos(4 * math.pi / 5)))
    assert [graph["name"] for graph in document["graphs"]] == ["line", "ring"]
    assert "consensus of 5 agents" in call("info", LINE_RING).stdout
    document = json.loads(call("info", bag, "--json").stdout)
    assert (document["experiment"], document["seed"], document["steps"]) == ("line_ring", 3, 1000)
    assert document["completeness"]["complete"]
    (mcap,) = bag.glob("*.mcap")
    assert json.loads(call("info", mcap, "--json").stdout)["run"] == document["run"]
    assert "complete: 5005 of 5005" in call("info", bag).stdout


def test_simulate_compresses_and_splits(tmp_path: Path) -> None:
    result = call(
        *("simulate", LINE_RING, "--duration", "50", "--out", tmp_path / "bag", "--compression", "lz4"),
        *("--split-size", "0.1"),
    )
    assert result.exit_code == 0, result.output
    document = json.loads(call("info", tmp_path / "bag", "--json").stdout)
    bags = [file for file in document["files"] if file["name"].endswith(".mcap")]
    assert len(bags) > 1
    assert {file["compression"] for file in bags} == {"lz4"}
    assert sum(file["messages"] for file in bags) == sum(topic["messages"] for topic in document["topics"])


def test_salvage_of_a_torn_bag(tmp_path: Path) -> None:
    """What is dropped is counted, and what comes out is compared as incomplete."""
    write_trajectory(simulate(golden("line_ring", duration=50, seed=3)), tmp_path / "bag", Storage(chunk_size=20_000))
    (mcap,) = (tmp_path / "bag").glob("*.mcap")
    torn, out = tmp_path / "torn.mcap", tmp_path / "out"
    data = mcap.read_bytes()
    torn.write_bytes(data[: len(data) // 2])
    told = json.loads(call("info", torn, "--json").stdout)
    result = call("salvage", torn, out, "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["kept_bytes"] + document["dropped_bytes"] == len(data) // 2
    assert document["kept_messages"] == told["files"][0]["messages"] > 0
    assert document["completeness"]["missing"] == told["completeness"]["missing"] > 0
    compared = call("compare", out, "--json")
    assert compared.exit_code == 3
    verdict = json.loads(compared.stdout)
    assert verdict["verdict"] == "incomplete"
    assert verdict["steps"] == document["prefix"] > 100
    assert verdict["system_error"]["measured"] > 0
    assert f"All steps up to step {verdict['completeness']['stretch'][1]}" in call("compare", out).stdout
    shown = " ".join(call("salvage", torn, tmp_path / "two").stdout.split())
    assert f"kept {document['kept_messages']} messages" in shown
    assert "after the last complete record" in shown


def test_salvage_of_nothing(bag: Path, tmp_path: Path) -> None:
    (mcap,) = bag.glob("*.mcap")
    head = tmp_path / "head.mcap"
    head.write_bytes(mcap.read_bytes()[:3000])
    for path, reason in (
        (head, "no whole message"),
        (tmp_path / "nope", "not found"),
        (ROOT / "LICENSE", "not an MCAP file"),
        (LINE_RING, "is an experiment file"),
    ):
        result = call("salvage", path, tmp_path / "out")
        assert (result.exit_code, result.stdout) == (2, "")
        assert reason in result.stderr
        assert {file.name for file in tmp_path.iterdir()} == {"head.mcap"}


def test_schema_is_the_committed_file() -> None:
    assert call("schema").stdout == (ROOT / "docs/experiment.schema.json").read_text(encoding="utf-8")


def caused_by(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (KeyboardInterrupt(), 130, ""),
        (caused_by(RuntimeError("Error calling __set_name__"), KeyboardInterrupt()), 130, ""),
        (OSError(28, "No space left on device", "some/file"), 2, "error: some/file: No space left on device\n"),
    ],
    ids=["interrupt", "interrupt while a class is made", "error of the user"],  # a fault of the program: test_shells.py
)
def test_errors_inside(error: BaseException, code: int, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path) -> None:
        raise error

    monkeypatch.setattr(experiments, "read_yaml", fail)
    result = call("predict", LINE_RING)
    assert (result.exit_code, result.stdout, result.stderr) == (code, "", words)
    assert result.exception is not error
