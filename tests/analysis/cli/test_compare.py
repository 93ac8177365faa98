"""``msg-analysis compare`` of several bags, and ``tabulate``, as a user calls them."""

import csv
import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from programs import call
from rich.console import Console

from experiments import changed, claimed, golden, simulate, write_trajectory
from msg_analysis.report.saved_results import print_results
from msg_analysis.runs import read_result


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two runs with leader 1, one with leader 2."""
    directory = tmp_path_factory.mktemp("bags")
    made = [directory / f"bag_{seed}" for seed in (1, 2, 3)]
    for seed, bag in enumerate(made, start=1):
        leader = ("--set", f"leaders.agents=[{1 if seed < 3 else 2}]")
        words = call("simulate", "leader_smallest", *leader, "--seed", seed, "--duration", 20, "--out", bag)
        assert words.exit_code == 0
    return made


@pytest.fixture(scope="module")
def results(bags: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    directory = tmp_path_factory.mktemp("results")
    saved = []
    for bag in bags:
        saved.append(directory / f"{bag.name}.json")
        saved[-1].write_text(call("compare", bag, "--json").stdout, encoding="utf-8")
    return saved


def test_the_result_of_one_bag_is_kept_with_it(bags: list[Path], tmp_path: Path) -> None:
    """For `runs`, beside what its network has said; not of several bags, and not with --no-save."""
    bag = Path(shutil.copytree(bags[0], tmp_path / "bag"))
    (bag / "result.json").unlink(missing_ok=True)
    call("compare", bag, bags[1])
    document = json.loads(call("compare", bag, "--no-save", "--json").stdout)
    assert not (bag / "result.json").exists()
    (bag / "result.json").write_text(
        json.dumps({"run": document["run"], "rate": 7.0, "restarts": ["agent_1: x"], "until": {"rule": "x"}})
    )
    call("compare", bag)
    saved = json.loads((bag / "result.json").read_text())
    assert (saved["rate"], saved["restarts"], saved["verdict"]) == (7.0, ["agent_1: x"], document["verdict"])
    assert saved["until"] == {"rule": "x"}
    assert json.loads(call("runs", tmp_path, "--json").stdout)["runs"][0]["verdict"] == document["verdict"]


def test_several_bags_get_one_verdict(bags: list[Path], tmp_path: Path) -> None:
    result = call("compare", *bags[:2], "--json", "--report", tmp_path / "report.html")
    document = json.loads(result.stdout)
    assert result.exit_code == {"agrees": 0, "disagrees": 1}[document["verdict"]]
    assert [bag["bag"] for bag in document["bags"]] == [str(bag) for bag in bags[:2]]
    assert document["simulated_time"] == pytest.approx(40.0)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h2>Runs</h2>" in page
    assert str(bags[1]) in page
    assert "2 runs" in call("compare", *bags[:2]).stdout


def test_bags_that_do_not_go_together(bags: list[Path], tmp_path: Path) -> None:
    for arguments, expected in (
        ((bags[0], bags[0]), "the same run as in"),
        ((bags[0], bags[2]), "leaders.agents: [2], but [1]"),
        ((bags[0], tmp_path / "nope", tmp_path / "nada"), f"{tmp_path / 'nope'}, {tmp_path / 'nada'}: not found"),
    ):
        result = call("compare", *arguments)
        assert (result.exit_code, result.stdout) == (2, "")
        assert expected in result.stderr
    assert call("compare", tmp_path / "nope").exit_code == 2
    assert call("compare").exit_code == 2


@pytest.mark.parametrize("level", ["0", "0.6", "-1", "nan", "x"])
def test_levels_that_are_none(bags: list[Path], level: str) -> None:
    assert call("compare", bags[0], "--level", level).exit_code == 2


def test_the_level_is_that_of_the_verdict(tmp_path: Path) -> None:
    """At the level of the least adjusted p-value, the verdict turns over; noise 3 % too large, a fixed seed."""
    law = golden("line_ring", duration=20, replicas=2)
    write_trajectory(claimed(simulate(changed(law, noise={"process": 1.03})), law), tmp_path / "bag")
    compared = json.loads(call("compare", tmp_path / "bag", "--json").stdout)
    least = min(test["p_adjusted"] for test in compared["tests"])
    result = call("compare", tmp_path / "bag", "--json", "--level", least * 1.01)
    document = json.loads(result.stdout)
    assert (result.exit_code, document["verdict"]) == (1, "disagrees")
    assert document["level"] == pytest.approx(least * 1.01)
    assert document["causes"]
    document = json.loads(call("compare", tmp_path / "bag", "--json", "--level", least / 2).stdout)
    assert document["verdict"] == "agrees"


@pytest.mark.parametrize("width", [60, 80, 40])
def test_tabulate_in_narrow_windows(results: list[Path], width: int) -> None:
    """No name of a run and no number is cut."""
    places = [
        results[0].parent / name / "result.json"
        for name in ("leaders_of_the_first_kind_1", "leaders_of_the_first_kind_2")
    ]
    for place, result in zip(places, results, strict=False):
        place.parent.mkdir(exist_ok=True)
        place.write_text(result.read_text())
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    print_results([read_result(place) for place in places], 0.01, console)
    lines = console.file.getvalue().splitlines()
    rows = [line.split() for line in lines if re.match(r"  \S*kind_[12] ", line)]
    assert [row[0] for row in rows] == [place.parent.name for place in places], lines
    for row, place in zip(rows, places, strict=True):
        error = json.loads(place.read_text())["system_error"]
        assert {f"{error['measured']:.6g}", f"{error['predicted']:.6g}", f"{error['z']:+.2f}"} <= set(row)
    assert width < 80 or max(map(len, lines[:6])) <= width


def test_tabulate_in_a_pipe(results: list[Path]) -> None:
    """Whole paths, for other commands, and all columns, in a line for each result."""
    lines = call("tabulate", *results).stdout.splitlines()
    assert {"experiment", "leaders", "verdict", "seed", "time", "predicted", "smallest"} <= set(lines[2].split())
    assert [line.split()[0] for line in lines[4:7]] == [str(path) for path in results]


def test_tabulate(results: list[Path], bags: list[Path]) -> None:
    rows = list(csv.DictReader(call("tabulate", *results, "--format", "csv").stdout.splitlines()))
    assert [row["leaders"] for row in rows] == ["1", "1", "2"]
    saved: dict[str, Any] = json.loads(results[1].read_text(encoding="utf-8"))
    assert float(rows[1]["measured"]) == saved["system_error"]["measured"]
    assert float(rows[1]["low"]) == saved["system_error"]["interval"][0]
    assert rows[1]["seeds"] == "2"
    document = json.loads(call("tabulate", *results, "--format", "json").stdout)
    assert [row["verdict"] for row in document["results"]] == [row["verdict"] for row in rows]
    (merged,) = document["merged"]
    pooled = json.loads(call("compare", *bags[:2], "--json").stdout)["system_error"]
    assert merged["files"] == [str(path) for path in results[:2]]
    assert {key: merged[key] for key in ("measured", "standard_error", "predicted", "z", "p")} == pytest.approx(
        {key: pooled[key] for key in ("measured", "standard_error", "predicted", "z", "p")}
    )
    order = document["order"]
    assert {(pair["better"], pair["worse"], pair["predicted"]) for pair in order["distinctions"]} == {
        (1, 3, True),
        (2, 3, True),
    }
    twice = json.loads(call("tabulate", results[0], results[0], "--format", "json").stdout)
    assert twice["merged"] == []
    table = call("tabulate", *results)
    assert table.exit_code == 0
    assert "has a smaller system error than" in " ".join(table.stdout.split())
    markdown = call("tabulate", *results, "--format", "markdown").stdout.splitlines()
    assert len(markdown) == 5
    assert len({line.count("|") for line in markdown}) == 1


def test_tabulate_of_a_directory_and_of_nothing(results: list[Path], tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text(results[0].read_text(encoding="utf-8"), encoding="utf-8")
    assert call("tabulate", tmp_path, "--format", "csv").stdout.splitlines()[1].startswith(str(tmp_path))
    assert call("tabulate").exit_code == 2
    assert "No such file" in call("tabulate", tmp_path / "nope.json").stderr
