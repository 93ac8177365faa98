"""The commands on logs of other robots: a first map, what is in a bag, the verdict and its exit codes."""

import csv
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from programs import run
from robots import LAW, SCRIPT, write_robots

from msg_analysis.errors import InputError
from msg_analysis.inference.log_verdict import LogComparison
from msg_analysis.testing import assert_agrees


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A right bag, and one whose link 2-3 is missing."""
    place = tmp_path_factory.mktemp("robots")
    write_robots(place / "good", 1500)
    write_robots(place / "bad", 800, missing=(2, 3))
    (place / "law.yaml").write_text(LAW)
    (place / "map.yaml").write_text(call("map", place / "good").stdout)
    return place


@pytest.fixture(scope="module")
def missing_link(robots: Path) -> tuple[str, str]:
    """What is shown of the bad bag, in full, and its report."""
    words = robots / "bad", "--law", robots / "law.yaml", "--map", robots / "map.yaml", "--verbose"
    shown = call("compare", *words, "--report", robots / "page.html").stdout
    return shown, (robots / "page.html").read_text()


def call(*words: Any) -> Any:
    return run("msg-analysis", *map(str, words))


def test_a_right_bag_agrees(robots: Path) -> None:
    result = call("compare", robots / "good", "--law", robots / "law.yaml", "--map", robots / "map.yaml")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("The log agrees with the law.\nrobots: 1500 samples in 149.9 units of time")
    assert "All 15 tests are ok" in result.stdout or "All 14 tests are ok" in result.stdout
    assert not (robots / "good/result.json").exists()


def test_a_missing_link_is_named(robots: Path, missing_link: tuple[str, str]) -> None:
    result = call("compare", robots / "bad", "--law", robots / "law.yaml", "--map", robots / "map.yaml", "--json")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["verdict"]) == (1, "disagrees")
    assert [cause["link"] for cause in document["causes"]] == [[2, 3]]
    assert document["causes"][0]["words"].endswith("it seems to be missing")
    shown, _ = missing_link
    assert shown.startswith("The log disagrees with the law.\n  the gain of edge 2-3 in both directions")
    assert "rejected" in shown


def test_the_report(missing_link: tuple[str, str]) -> None:
    """One file that loads nothing: the text of the terminal, and a picture with every agent."""
    shown, page = missing_link
    text = html.unescape(re.sub(r"<[^>]*>", "", page[page.index("<pre>") : page.index("</pre>")]))
    assert " ".join(shown.splitlines()[1].split()) in " ".join(text.split())
    assert page.count("<svg") == 1
    assert not re.search(r"(src|href)=.(?!#)", page)


def test_assert_agrees_with_a_law(robots: Path, tmp_path: Path) -> None:
    given: dict[str, Any] = {"law": robots / "law.yaml", "map": robots / "map.yaml"}
    found = assert_agrees(robots / "good", **given)
    assert isinstance(found, LogComparison)
    assert assert_agrees(found.log).verdict == "agrees"
    with pytest.raises(AssertionError, match=r"disagrees.*gain of edge 2-3 in both directions.*seems to be missing"):
        assert_agrees(robots / "bad", **given, report=tmp_path / "pages/bad.html")
    assert (tmp_path / "pages/bad.html").exists()
    with pytest.raises(InputError, match="map: missing: expected the file that says where the states in the log are"):
        assert_agrees(robots / "good", law=robots / "law.yaml")
    with pytest.raises(InputError, match="2 logs: expected one log"):
        assert_agrees(robots / "good", robots / "bad", **given)


def test_graphs_that_are_not_in_the_log(robots: Path, tmp_path: Path) -> None:
    lines = (robots / "map.yaml").read_text().splitlines()
    mapped = tmp_path / "map.yaml"
    mapped.write_text("\n".join("graph: hidden" if line.startswith("graph:") else line for line in lines))
    words = "compare", robots / "good", "--law", robots / "law.yaml", "--map", mapped
    result = call(*words, "--report", tmp_path / "page.html")
    assert result.exit_code == 0, result.output
    for part in ("expected over all paths", "all rates of the switching", "Approximate: ", "models", "Not tested: "):
        assert part in result.stdout
    page = (tmp_path / "page.html").read_text()
    assert "models" in page
    assert "<!-- ring -->" not in page  # no band of a path that is not known
    found = json.loads(call("compare", robots / "bad", *words[2:], "--json").stdout)["factors"]
    assert all(found[kind]["interval"][0] >= 0.0 for kind in ("noise", "rates"))
    mapped.write_text(mapped.read_text().replace("graph: hidden", "graph: {hidden: true, fixed: line}"))
    assert "graph: hidden" in call(*words).stderr


def test_the_spectrum_by_a_map(robots: Path, tmp_path: Path) -> None:
    words = "spectrum", robots / "good", "--law", robots / "law.yaml", "--map", robots / "map.yaml"
    result = call(*words, "--json", "--figure", tmp_path / "spectrum.png")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["agrees"], document["note"]) == (0, True, None)
    assert document["log"]["lags"][1] == pytest.approx(0.1)
    assert (tmp_path / "spectrum.png").exists()
    assert "The log agrees with the predicted autocovariance" in call(*words).stdout
    assert "--law: missing" in call(*words[:2], "--map", robots / "map.yaml").stderr


def test_export_by_a_map(robots: Path, tmp_path: Path) -> None:
    """The states that were written, to the nanosecond and the last bit; see ``write_robots``."""
    times, states, starts, names = SCRIPT["simulate"](SCRIPT["Kind"](), 1500, np.random.default_rng(1))
    words = "export", robots / "good", "--map", robots / "map.yaml", "--out", tmp_path
    result = call(*words, "--csv", "--parquet", "--npz", "--json")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["missing"]) == (0, 0)
    assert sorted(Path(file).name for file in document["files"]) == sorted(
        ["states.csv", "graphs.csv", "states.parquet", "graphs.parquet", "log.npz"]
    )
    with np.load(tmp_path / "log.npz") as arrays:
        assert np.array_equal(arrays["states"][:, :, 0], states)
        np.testing.assert_allclose(arrays["times"], times, atol=2e-9)
        np.testing.assert_allclose(arrays["starts"], starts, atol=2e-9)
        assert arrays["path"].tolist() == names
    with (tmp_path / "states.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["state"]) for row in rows] == states.ravel().tolist()
    assert [row["agent"] for row in rows[:6]] == ["1", "2", "3", "4", "5", "1"]
    table = pyarrow.parquet.read_table(tmp_path / "graphs.parquet").to_pydict()
    assert table["graph_name"] == names
    assert "expected --csv, --parquet or --npz" in call(*words, "--rrd").stderr
    (tmp_path / "taken/log.npz").mkdir(parents=True)
    assert call(*words[:-1], tmp_path / "taken", "--csv", "--npz").exit_code == 2
    assert [file.name for file in (tmp_path / "taken").iterdir()] == ["log.npz"]  # nothing is half-written


def test_what_is_in_a_bag(robots: Path) -> None:
    result = call("map", robots / "good", "--check")
    assert result.exit_code == 0, result.output
    assert "/robot_3/odom" in result.stdout
    assert "All agents have a value at 100 % of the sample times." in result.stdout
    document = json.loads(call("map", robots / "good", "--map", robots / "map.yaml", "--check", "--json").stdout)
    assert [each["rate"] for each in document["agents"]] == pytest.approx([10.0] * 5)


def test_a_table_needs_no_map(robots: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    np.savez(tmp_path / "data.npz", time=np.arange(100.0), **{f"x{i}": rng.normal(size=100) for i in range(1, 6)})
    result = call("compare", tmp_path / "data.npz", "--law", robots / "law.yaml")
    assert result.exit_code == 2
    assert "graph: missing: expected which of line, ring was there when" in result.stderr
    (tmp_path / "law.yaml").write_text("{name: one, graphs: {line: {path: [1, 2, 3, 4, 5]}}}")
    result = call("compare", tmp_path / "data.npz", "--law", tmp_path / "law.yaml")
    assert (result.exit_code, result.stdout.splitlines()[0]) == (1, "The log disagrees with the law.")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "good"], "for a bag of other robots `msg-analysis map good` writes a first map"),
        (["compare", "good", "--law", "law.yaml"], "--map: missing: expected where the states in good are"),
        (["compare", "good", "--map", "map.yaml"], "--law: missing: expected the experiment file"),
        (["compare", "good", "bad", "--law", "law.yaml", "--map", "map.yaml"], "bad: expected one bag or table"),
        (["compare", "good", "--law", "law.yaml", "--map", "law.yaml"], "name: unknown key"),
        (["map", "good", "--json"], "--json: expected with --check"),
        (["map", "absent"], "absent: not found"),
        (["compare", "absent.csv", "--law", "law.yaml"], "absent.csv: no such file"),
        (["compare", "words.csv", "--law", "law.yaml"], "words.csv: column 3: expected numbers"),
    ],
)
def test_mistakes(words: list[str], message: str, robots: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(robots)
    Path("words.csv").write_text("time,1,2,3,4,5,graph\n0,1,2,3,4,5,line\n1,1,2,x,4,5,line\n")
    result = call(*words)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


def test_the_schema_is_that_of_the_docs() -> None:
    file = Path(__file__).parents[3] / "docs/map.schema.json"
    assert call("schema", "map").stdout == file.read_text(encoding="utf-8")
