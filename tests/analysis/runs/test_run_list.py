"""Lists of runs: what each folder is called, filters, order and dates; a foreign one ends nothing."""

import dataclasses
import fcntl
import json
import os
import shutil
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from msg_analysis import Experiment, InputError
from msg_analysis.bags.reading import read_bag
from msg_analysis.cli.main import main
from msg_analysis.runs import RunEntry, RunFilter, list_runs, moment, read_result

APART = {"apart": {"path": [1, 2, 3]}}
PAIR = {"name": "pair", "graphs": APART, "run": {"dt": 0.1, "duration": 5, "seed": 7, "start": "zero"}}
RESULT: dict[str, Any] = {  # by hand: what a list takes from a result
    "verdict": "disagrees",
    "run": "8c6d",
    "experiment": "pair",
    "seed": 8,
    "simulated_time": 5.0,
    "system_error": {"measured": 1.5, "predicted": 1.0, "standard_error": 0.25, "z": 2.0, "interval": [1.0100, 1.9900]},
}
SHORT = {"measured": None, "predicted": None, "standard_error": None, "z": None, "interval": [None, None]}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Experiment.parse(PAIR).simulate().save(tmp_path_factory.mktemp("bag") / "pair_20261125_120000")


def result(folder: Path, **changes: Any) -> Path:
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "result.json").write_text(json.dumps(RESULT | changes))
    return folder


def only(folder: Path) -> RunEntry:
    (entry,) = list_runs(folder)
    return entry


def test_a_run_with_a_result(tmp_path: Path, bag: Path) -> None:
    """Of the bag beside it, nothing is read."""
    folder = result(tmp_path / "pair_20261125_130501_2")
    (folder / "pair_0.mcap").write_bytes(b"not read")
    (folder / "report.html").write_text("")
    entry = only(tmp_path)
    assert entry.date == datetime(2026, 11, 25, 13, 5, 1, tzinfo=UTC)
    kept = {key: RESULT[key] for key in ("verdict", "run", "seed", "simulated_time")}
    kept |= {key: RESULT["system_error"][key] for key in ("measured", "predicted", "standard_error", "z")}
    kept |= {"status": "compared", "date": entry.date.isoformat(), "problem": None, "name": "pair", "prediction": None}
    kept |= {"folder": str(folder), "report": str(folder / "report.html"), "given_path": False}
    assert entry.to_json() == kept | {"low": pytest.approx(1.01, abs=1e-4), "high": pytest.approx(1.99, abs=1e-4)}


def test_a_run_without_a_step_has_no_error(tmp_path: Path) -> None:
    result(tmp_path / "pair_20261125_130501", verdict="incomplete", simulated_time=0.0)
    assert (only(tmp_path).measured, only(tmp_path).z) == (None, None)


def test_a_result_of_before(tmp_path: Path) -> None:
    """Its causes have another key."""
    cause = {"words": "the noise is too large"}
    for key in ("causes", "blame"):
        assert read_result(result(tmp_path / key, **{key: [cause]})).causes == cause["words"]


def test_a_short_run_has_the_error_given_the_path(tmp_path: Path) -> None:
    given = {"measured": 1.4, "predicted": 1.0, "standard_error": 0.1, "z": 4.0}
    total = SHORT | {"measured": 1.5, "predicted": 1.0}
    result(tmp_path / "a", system_error=total, given_path={"system_error": given})
    entry = only(tmp_path)
    assert (entry.measured, entry.standard_error, entry.z, entry.given_path) == (1.4, 0.1, pytest.approx(4.0), True)


def test_runs_without_a_result(tmp_path: Path, bag: Path) -> None:
    """Whole, torn, being recorded; the date is that of the record."""
    shutil.copytree(bag, tmp_path / bag.name)
    entry = only(tmp_path)
    assert (entry.status, entry.name, entry.seed, entry.verdict) == ("not compared", "pair", 7, None)
    assert entry.run == str(read_bag(bag).record.run)
    assert entry.date == read_bag(bag).record.started
    (file,) = (tmp_path / bag.name).glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-500])
    (tmp_path / bag.name / "metadata.yaml").unlink()
    entry = only(tmp_path)
    assert (entry.status, entry.name) == ("torn", "pair")
    with (tmp_path / bag.name / ".recording").open("w") as marker:
        json.dump({"pid": os.getpid()}, marker)
        marker.flush()
        fcntl.flock(marker, fcntl.LOCK_EX)
        assert only(tmp_path).status == "recording"
    file.write_bytes(file.read_bytes()[:30])
    assert only(tmp_path).status == "foreign"  # nobody knows which run that was


def test_a_record_that_only_a_topic_has(tmp_path: Path, bag: Path) -> None:
    """As in bags of ros2 bag: here the head of our own is made unknown."""
    shutil.copytree(bag, tmp_path / "other")
    (file,) = (tmp_path / "other").glob("*.mcap")
    length, data = b"\x0a\x00\x00\x00", file.read_bytes()
    assert length + b"msg_agents" in data
    file.write_bytes(data.replace(length + b"msg_agents", length + b"other_tool", 1))
    entry = only(tmp_path)
    assert (entry.status, entry.name, entry.seed) == ("not compared", "pair", 7)


def test_other_folders_are_listed_with_a_word(tmp_path: Path) -> None:
    for folder in ("empty/log", "photos", "bag", ".hidden"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("photos/a.jpg", "bag/bag_0.mcap", "index.html"):
        (tmp_path / file).write_text("text")
    for name, text in {"a": "{", "b": "[]", "c": json.dumps(RESULT | {"tests": 5}), "d": "{}"}.items():
        result(tmp_path / f"result_{name}")
        (tmp_path / f"result_{name}" / "result.json").write_text(text)
    found = {Path(entry.folder).name: entry for entry in list_runs(tmp_path)}
    damaged = {f"result_{name}": "damaged" for name in "abcd"}
    expected = damaged | {"empty": "empty", "photos": "foreign", "bag": "foreign"}
    assert {name: entry.status for name, entry in found.items()} == expected
    assert "tests: expected a list of objects" in (found["result_c"].problem or "")


@pytest.mark.parametrize("zone", ["America/New_York", "Asia/Tokyo", "Pacific/Kiritimati"])
def test_dates_do_not_depend_on_the_zone_of_a_machine(zone: str, tmp_path: Path, bag: Path, monkeypatch: Any) -> None:
    """The folder was named by another clock; the record has UTC."""
    began = read_bag(bag).record.started
    shutil.copytree(bag, tmp_path / "pair_20260101_000000")
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        entry = only(tmp_path)
        since = moment(f"{began:%Y-%m-%dT%H:%M:%S}", "--since", began)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert entry.to_json()["date"] == f"{began:%Y-%m-%dT%H:%M:%S}+00:00"
    assert RunFilter(since=since).choose([entry]) == [entry]


def test_dates_without_a_name(tmp_path: Path) -> None:
    """By the record; else by the bag, unless that has the simulated time of the twin; else by the file."""
    run = Experiment.parse(PAIR).simulate()
    began = datetime(2026, 9, 1, 12, tzinfo=UTC)
    for name, start in (("recorded", began), ("clocked", None), ("pair_20269999_120000", None)):  # not a date
        record = dataclasses.replace(run.record, started=start or began)
        dataclasses.replace(run, record=record).save(tmp_path / name)
        if start is None:
            (file,) = (tmp_path / name).glob("*.mcap")
            file.write_bytes(file.read_bytes().replace(b'"started"', b'"no_time"'))
    metadata = tmp_path / "clocked" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("epoch: 0\n", "epoch: 1795000000000000000\n", 1))
    os.utime(file, (1_790_000_000, 1_790_000_000))  # of the last one
    assert [(Path(entry.folder).name, entry.date.timestamp()) for entry in list_runs(tmp_path)] == [
        ("recorded", began.timestamp()),
        ("pair_20269999_120000", 1_790_000_000),
        ("clocked", 1_795_000_000),
    ]


def test_what_is_not_a_folder_of_runs(tmp_path: Path, bag: Path) -> None:
    (tmp_path / "file").write_text("")
    for path, words in ((tmp_path / "none", "No such file"), (tmp_path / "file", "a file"), (bag, "a bag: give the")):
        with pytest.raises(InputError, match=words):
            list_runs(path)
    assert list_runs(tmp_path) == []


NOW = datetime(2026, 11, 25, 12, 0, tzinfo=UTC)


def entry(folder: str, day: int, **fields: Any) -> RunEntry:
    return RunEntry(folder, "compared", datetime(2026, 11, day, tzinfo=UTC), **fields)


RUNS = [
    entry("a", 1, name="line", seed=3, verdict="agrees", measured=2.0),
    entry("b", 2, name="ring", seed=1, verdict="disagrees", measured=1.0),
    entry("c", 3, name="line_ring", seed=3, verdict="agrees", measured=3.0),
    entry("d", 4),
]


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ({}, "abcd"),
        ({"name": "line"}, "a"),
        ({"name": "line*"}, "ac"),
        ({"name": "*"}, "abc"),
        ({"verdicts": ("agrees",)}, "ac"),
        ({"verdicts": ("none", "disagrees")}, "bd"),
        ({"seed": 3}, "ac"),
        ({"since": datetime(2026, 11, 2, tzinfo=UTC)}, "bcd"),
        ({"until": datetime(2026, 11, 2, tzinfo=UTC)}, "a"),
        ({"last": 2}, "cd"),
        ({"last": 9}, "abcd"),
        ({"seed": 3, "last": 1}, "c"),
    ],
)
def test_filters(wanted: dict[str, Any], found: str) -> None:
    assert "".join(entry.folder for entry in RunFilter(**wanted).choose(RUNS[::-1])) == found


@pytest.mark.parametrize(
    ("key", "found"), [("date", "abcd"), ("name", "acbd"), ("seed", "bacd"), ("verdict", "acbd"), ("error", "bacd")]
)
def test_order(key: Any, found: str) -> None:
    assert "".join(entry.folder for entry in RunFilter().choose(RUNS[::-1], key)) == found


@pytest.mark.parametrize(
    ("text", "end", "found"),
    [
        ("30m", False, NOW - timedelta(minutes=30)),
        ("12h", True, NOW - timedelta(hours=12)),
        ("7d", False, NOW - timedelta(days=7)),
        ("2026-11-25", False, datetime(2026, 11, 25, tzinfo=UTC)),
        ("2026-11-25", True, datetime(2026, 11, 26, tzinfo=UTC)),
        ("2026-11-25T14:30", True, datetime(2026, 11, 25, 14, 30, tzinfo=UTC)),
        ("2026-11-25T14:30+02:00", False, datetime(2026, 11, 25, 12, 30, tzinfo=UTC)),
    ],
)
def test_moments(text: str, end: bool, found: datetime) -> None:
    assert moment(text, "--since", NOW, end=end) == found


@pytest.mark.parametrize("text", ["", "yesterday", "2026-13-01", "7w", "-3d", "999999d"])
def test_what_is_not_a_moment(text: str) -> None:
    with pytest.raises(InputError, match=r"--until .*: expected a date"):
        moment(text, "--until", NOW)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("system_error", '{"measured": 1' + 400 * "0" + ', "interval": [1, 2]}'),
        ("simulated_time", "1e308"),
        ("seed", 400 * "9"),
        ("seed", 5000 * "9"),
        ("names", 990 * "[" + 990 * "]"),
        ("names", 100_000 * "["),
        ("experiment", '"\\ud800"'),
        ("bags", "7"),
        ("experiment", "null"),
        ("system_error", '{"interval": 3}'),
        ("system_error", '{"interval": [1, "x"]}'),
        ("", ""),  # a FIFO instead of the file
    ],
    ids=range(12),
)
def test_one_broken_result(tmp_path: Path, key: str, text: str) -> None:
    """It is one line; the list, the table and the page have the other run."""
    good, bad = result(tmp_path / "runs/good"), result(tmp_path / "runs/bad")
    file = bad / "result.json"
    file.write_text(json.dumps(RESULT | {key: "@"}).replace('"@"', text))
    if not key:
        file.unlink()
        os.mkfifo(file)
    listed = {Path(run.folder).name: run for run in list_runs(tmp_path / "runs")}
    assert (listed["good"].status, listed["bad"].status) == ("compared", "damaged")
    assert str(file) in str(listed["bad"].problem)
    found = CliRunner().invoke(main, ["tabulate", str(good), str(bad), "--json"])
    assert [row["file"] for row in json.loads(found.stdout)["results"]] == [str(good)]
    assert found.stderr.startswith(f"note: not readable: {file}")
    assert len(found.stderr) < 1000
    assert (
        CliRunner().invoke(main, ["runs", str(tmp_path / "runs"), "--page", str(tmp_path / "page.html")]).exit_code == 0
    )
    assert CliRunner().invoke(main, ["tabulate", str(bad)]).exit_code == 2
