"""Exported runs, read by pyarrow, pandas, numpy and csv, against the messages in the bag as rosbags has them."""

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from click.testing import Result
from programs import run as call
from rosbags.highlevel import AnyReader

from experiments import document
from msg_analysis import Experiment, InputError, NotAvailableError, Run, read_bag
from msg_analysis.report import export as export_files

DOCUMENT = document(names=["one, 1", 'two "2"', "three"], run={"duration": 15, "seed": 4})


def export(*arguments: str | Path) -> Result:
    return call("msg-analysis", "export", *arguments)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Experiment.parse(DOCUMENT).simulate().save(tmp_path_factory.mktemp("bags") / "net")


@pytest.fixture(scope="module")
def exported(bag: Path) -> Path:
    """All formats, by the command; in pieces of a few steps they are the same."""
    folder, others = bag.parent / "data", bag.parent / "pieces"
    result = export(bag, "--csv", "--parquet", "--npz", "--out", folder)
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == [str(folder / name) for name in NAMES]
    assert sorted(file.name for file in folder.iterdir()) == sorted(NAMES)
    for file in export_files.export_run(read_bag(bag), others, ["csv", "parquet", "npz"], rows=7 * 6):
        if file.suffix == ".parquet":
            assert pyarrow.parquet.ParquetFile(file).num_row_groups > 40
            assert pyarrow.parquet.read_table(file).equals(pyarrow.parquet.read_table(folder / file.name))
        else:
            assert file.read_bytes() == (folder / file.name).read_bytes()
    return folder


def test_csv_and_arrays_need_no_pyarrow(exported: Path, bag: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """A new one beside an older NumPy cannot be imported; it quotes headers, and leaves the zeros of 1.0 out."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result = export(bag, "--csv", "--npz", "--out", tmp_path)
    assert result.exit_code == 0, result.output

    def parsed(cell: str) -> str | float:
        try:
            return float(cell)
        except ValueError:
            return cell

    for name in ("states.csv", "graphs.csv", "errors.csv"):
        ours, theirs = (
            [[parsed(cell) for cell in row] for row in csv.reader((folder / name).open(newline=""))]
            for folder in (tmp_path, exported)
        )
        assert ours == theirs
    assert (tmp_path / "run.npz").read_bytes() == (exported / "run.npz").read_bytes()
    refused = export(bag, "--parquet", "--out", tmp_path)
    assert refused.exit_code == 2
    assert "Parquet: pyarrow cannot be loaded" in refused.stderr


NAMES = [f"{table}.{form}" for form in ("csv", "parquet") for table in ("states", "graphs", "errors")] + ["run.npz"]


@pytest.fixture(scope="module")
def messages(bag: Path, typestore: Any) -> tuple[dict[tuple[int, int], Any], dict[int, int]]:
    """Of rosbags: states by step and agent, and the graph of each step."""
    states, graphs = {}, {}
    with AnyReader([bag], default_typestore=typestore) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic.endswith("/state"):
                message: Any = reader.deserialize(raw, connection.msgtype)
                states[message.step, message.agent] = message.state
            elif connection.topic.endswith("graph"):
                message = reader.deserialize(raw, connection.msgtype)
                graphs |= dict.fromkeys(range(message.first_step, message.last_step + 1), message.mode)
    return states, graphs


def test_states_in_every_format(exported: Path, messages: Any, bag: Path) -> None:
    states, _ = messages
    assert len(states) == 301 * 3
    table = pyarrow.parquet.read_table(exported / "states.parquet").to_pydict()
    assert list(table) == ["step", "time", "agent", "name", "replica", "state"]
    rows = list(zip(*table.values(), strict=True))
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    assert len(rows) == 301 * 3 * 2
    for step, time, agent, name, replica, state in rows:
        assert state == states[step, agent][replica - 1]
        assert time == step * 0.05
        assert name == DOCUMENT["names"][agent - 1]
    with (exported / "states.csv").open(newline="") as stream:
        head, *lines = csv.reader(stream)
    assert head == list(table)
    kinds = (int, float, int, str, int, float)
    assert [tuple(kind(cell) for kind, cell in zip(kinds, line, strict=True)) for line in lines] == rows
    arrays = np.load(exported / "run.npz")
    assert arrays["states"].shape == (301, 3, 2)
    assert all(np.array_equal(arrays["states"][step, agent - 1], value) for (step, agent), value in states.items())
    frame = read_bag(bag).to_dataframe()
    assert frame.equals(pd.read_parquet(exported / "states.parquet"))


def test_graphs_in_every_format(exported: Path, messages: Any, bag: Path) -> None:
    graphs = [messages[1][step] for step in range(300)]
    assert len(set(graphs)) == 2
    frame = pd.read_parquet(exported / "graphs.parquet")
    assert list(frame.columns) == ["step", "time", "graph", "graph_name"]
    assert frame["graph"].tolist() == graphs
    assert frame["graph_name"].tolist() == [["line", "ring"][graph - 1] for graph in graphs]
    assert pd.read_csv(exported / "graphs.csv")["graph"].tolist() == graphs
    arrays = np.load(exported / "run.npz")
    assert (arrays["modes"] + 1).tolist() == graphs
    assert arrays["graph_names"].tolist() == ["line", "ring"]
    assert arrays["adjacency"][0].tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]
    assert read_bag(bag).to_dataframe("graphs").equals(frame)


def test_errors_in_every_format(exported: Path, messages: Any, bag: Path) -> None:
    """Against the states by hand; their means are the measured errors of the comparison."""
    states = np.array([[messages[0][step, agent] for agent in (1, 2, 3)] for step in range(301)])
    wanted = np.square(states - states.mean(axis=1, keepdims=True)).mean(axis=2)
    frame = pd.read_parquet(exported / "errors.parquet")
    assert list(frame.columns) == ["step", "time", "system_error", "error_1", "error_2", "error_3"]
    np.testing.assert_allclose(frame[["error_1", "error_2", "error_3"]], wanted, rtol=1e-12)
    np.testing.assert_allclose(frame["system_error"], wanted.sum(axis=1), rtol=1e-12)
    assert np.array_equal(
        pd.read_csv(exported / "errors.csv", float_precision="round_trip").to_numpy(), frame.to_numpy()
    )
    np.testing.assert_allclose(np.load(exported / "run.npz")["errors"], wanted, rtol=1e-12)
    run = read_bag(bag)
    assert run.to_dataframe("errors").equals(frame)
    measured = run.compare().system_error.measured
    assert frame["system_error"][:300].mean() == pytest.approx(measured, rel=1e-12)


def test_the_run_record_is_in_the_files(exported: Path, bag: Path) -> None:
    record = read_bag(bag).record.to_json()
    kept = pyarrow.parquet.read_schema(exported / "graphs.parquet").metadata[b"msg_analysis.run_record"]
    assert kept.decode() == str(np.load(exported / "run.npz")["run_record"]) == record
    assert np.load(exported / "run.npz")["names"].tolist() == DOCUMENT["names"]


def test_what_is_missing_is_empty(tmp_path: Path) -> None:
    """Of a torn bag: exit code 3, and nulls where states and graphs are not there."""
    (file,) = Experiment.parse(DOCUMENT).simulate(duration=150).save(tmp_path / "net").glob("*.mcap")
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    run = read_bag(torn)
    assert 0 < run.completeness.missing < run.completeness.expected
    result = export(torn, "--parquet", "--csv", "--out", tmp_path / "data", "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["missing"] == run.completeness.missing + run.completeness.missing_modes
    frame = pd.read_parquet(tmp_path / "data/states.parquet")
    assert len(frame) == 3001 * 3 * 2
    assert frame["state"].isna().sum() == 2 * run.completeness.missing
    assert np.array_equal(frame["state"].to_numpy(), run.states.ravel(), equal_nan=True)
    assert pd.read_csv(tmp_path / "data/states.csv")["state"].isna().sum() == 2 * run.completeness.missing
    assert run.to_dataframe("graphs")["graph"].isna().sum() == run.completeness.missing_modes


def test_numbers_of_other_runs(tmp_path: Path) -> None:
    """What agents publish, and in real time when; without names there is no column for them."""
    noisy = Experiment.parse(document(run=DOCUMENT["run"]) | {"noise": {"broadcast": 0.5, "loss": 0.1}}).simulate(
        duration=1
    )
    frame = noisy.to_dataframe()
    assert list(frame.columns) == ["step", "time", "agent", "replica", "state", "published"]
    assert frame["published"].tolist() == noisy.published.ravel().tolist()
    timed = Experiment.parse(document(run=DOCUMENT["run"])).with_run(pace="realtime", duration=1).simulate()
    frame = timed.to_dataframe()
    assert list(frame.columns) == ["step", "time", "agent", "replica", "state", "made"]
    assert frame["made"].tolist() == np.repeat(timed.made.ravel() / 1e9, 2).tolist()
    export_files.export_run(noisy, tmp_path, ["npz"])
    assert {"published", "lost"} <= set(np.load(tmp_path / "run.npz"))


def test_mistakes(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, words in (
        ([bag], "no format: expected at least one of --csv, --parquet, --npz, --rrd"),
        ([tmp_path / "no", "--csv"], "not found: expected the directory of a bag"),
        ([bag, "--csv", "--out", bag / "metadata.yaml"], "metadata.yaml: cannot be written (File exists)"),
    ):
        result = export(*arguments)
        assert (result.exit_code, result.stdout) == (2, "")
        assert words in result.stderr
    monkeypatch.setitem(sys.modules, "rerun", None)  # as if it were not installed, which is told first
    result = export(bag, "--csv", "--rrd", "--out", tmp_path / "data")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "error: --rrd: rerun-sdk is not installed: expected it for recordings of Rerun: pip install rerun-sdk\n"
    )
    assert not (tmp_path / "data").exists()
    run = read_bag(bag)
    with pytest.raises(InputError, match="to_dataframe: 'nodes': expected one of states, graphs, errors"):
        run.to_dataframe("nodes")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(NotAvailableError, match=r"pandas is not installed: .*: pip install pandas"):
        run.to_dataframe()


def test_files_are_replaced_whole_or_not_at_all(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "graphs.csv").write_text("old")
    run: Run = read_bag(bag)

    graphs = export_files._COLUMNS["graphs"]

    def full(run: Run, first: int, end: int) -> Any:
        if end > 0:
            raise OSError(28, "No space left on device")
        return graphs(run, first, end)

    monkeypatch.setitem(export_files._COLUMNS, "graphs", full)
    with pytest.raises(InputError, match=r"graphs\.csv: cannot be written \(No space left on device\)"):
        export_files.export_run(run, tmp_path, ["csv"])
    assert (tmp_path / "graphs.csv").read_text() == "old"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["graphs.csv", "states.csv"]
    monkeypatch.undo()
    export_files.export_run(run, tmp_path, ["csv"])
    assert (tmp_path / "graphs.csv").read_text().startswith('"step"')
