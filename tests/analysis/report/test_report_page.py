"""The report and the page of the runs: valid, self-contained, complete, and safe with any name."""

import dataclasses
import json
import re
from datetime import UTC, datetime, timedelta
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from report_texts import without_figures

from experiments import Completeness, claimed, compare, late, line_ring, simulate
from msg_analysis import Experiment, InputError
from msg_analysis.inference.comparison import Comparison
from msg_analysis.report import page as report_page
from msg_analysis.report.drawings import plus_minus
from msg_analysis.report.list_pages import render_runs, write_runs_page
from msg_analysis.report.page import render, write_report
from msg_analysis.runs import RunEntry, list_runs

VOID = {"meta", "img", "link", "br", "hr", "input"}


class Page(HTMLParser):
    """Checks the nesting and keeps what tests ask for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.references: list[str] = []
        self.classes: list[str] = []
        self.text, self.data, self._kind = "", "", ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "action", "data")]
        self.classes += (given.get("class") or "").split()
        shown = tag == "svg" or "plot" in (given.get("class") or "").split()
        assert not shown or {"aria-label", "aria-hidden"} & given.keys()
        if tag not in VOID:
            self.open.append(tag)
        self._kind = given.get("type") or ""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data
        elif self._kind == "application/json":
            self.data += data


def _page(comparison: Comparison, path: Path) -> Page:
    write_report(comparison, path)
    return _checked(path.read_text(encoding="utf-8"))


def _checked(text: str) -> Page:
    assert len(text.encode()) < 3_000_000
    page = Page(text)
    assert all(reference.startswith("#") for reference in page.references)
    assert "default-src 'none'" in text
    own = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"url\(|@import", own)
    for drawing in re.findall(r"<svg.*?</svg>", own, flags=re.DOTALL):
        ElementTree.fromstring(drawing)
    return page


def _short(**changes: Any) -> Experiment:
    return line_ring(**changes, run={"dt": 0.1, "duration": 40, "start": "zero"})


@cache
def _agreeing(agents: int) -> tuple[Comparison, str]:
    """A comparison and its report."""
    graphs = {"line": {"path": list(range(1, agents + 1))}, "grid": {"grid": [1, agents]}}
    comparison = compare(simulate(_short(graphs=graphs)))
    return comparison, render(comparison)


@pytest.mark.parametrize("agents", [2, 5, 45])  # of more than 40, figures have no numbers
def test_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agents: int) -> None:
    comparison, text = _agreeing(agents)
    monkeypatch.setattr(report_page, "render", lambda *_, **__: text)
    (tmp_path / "report.html").write_text("old")
    page = _page(comparison, tmp_path / "report.html")
    assert "The run agrees with the prediction." in page.text
    assert str(comparison.trajectory.record.run) in page.text
    error = comparison.system_error
    assert f"{plus_minus(error.measured, error.interval)} (95 %)" in page.text
    assert f"z = {error.z:+.2f}".replace("-", "−") in page.text
    for node in comparison.node_errors:
        assert plus_minus(node.measured, (None, None)) in page.text
    assert page.classes.count("plot") == 13
    assert page.tags.count("svg") == 3  # two graphs and the chain
    with pytest.raises(InputError, match="cannot be written"):
        write_report(comparison, tmp_path / "nowhere" / "report.html")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize("first_gap", [5, 250])
def test_incomplete(tmp_path: Path, first_gap: int) -> None:
    trajectory = simulate(_short())
    trajectory.states[first_gap, 1] = np.nan
    count = Completeness(expected=1203, received=1202, missing=1, refused={"torn file": 1})
    trajectory = dataclasses.replace(trajectory, completeness=count)
    page = _page(compare(trajectory), tmp_path / "report.html")
    assert "No verdict: the data are incomplete." in page.text
    assert "Missing: 1 of 1203 states" in page.text
    assert ("too early to compute" in page.text) == (first_gap == 5)
    assert "rejected: torn file" in page.text


def test_what_became_of_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only where something did; texts from outside are texts."""
    comparison, quiet = _agreeing(2)
    assert "Network" not in Page(quiet).text
    without_figures(monkeypatch)
    rejected = {"node": "agent_1", "topic": "<b>graph", "reason": "other run", "count": 1234}
    path = tmp_path / "report.html"
    restarts = ["agent_2: killed by SIGKILL after step 7, started again"]
    write_report(comparison, path, restarts=restarts, rejected_messages=[rejected])
    page = Page(path.read_text(encoding="utf-8"))
    for words in (*restarts, "<b>graph", "other run", "1234"):
        assert words in page.text


def test_hostile_names(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>$\\frac$&\"'"
    trajectory = simulate(_short(graphs={evil: {"path": [1, 2, 3]}}, switching={}))
    trajectory.record.versions["<b>numpy"] = "</pre><img src=http://x>"
    page = _page(compare(trajectory), tmp_path / "report.html")
    assert evil in page.text
    assert page.tags.count("script") == 3
    assert page.tags.count("img") == 0


def in_real_time(nanoseconds: int) -> Comparison:
    """Every step of every agent is late by so many ns of simulated time."""
    run = {"dt": 0.1, "pace": "realtime", "speed": 10}
    return compare(late(simulate(line_ring(run=run)), nanoseconds))


def test_real_time_has_its_sections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    comparison = in_real_time(150_000_000)
    write_report(comparison, tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text())
    assert "The run was late, so it is no test of the prediction (at most 5 % may be missed)." in page.text
    assert "is not supported; 100 % of the deadlines were missed." in page.text
    texts = ("Real time", "lateness [ms]", "600 of 600 (100 %)", "Models", "predicted, logged pattern")
    for text in texts:
        assert text in page.text
    assert page.classes.count("plot") == 16
    without_figures(monkeypatch)
    on_time = in_real_time(0)
    write_report(on_time, tmp_path / "report.html")
    text = Page((tmp_path / "report.html").read_text()).text
    assert "The agents follow the model, given what they received; the prediction for real time is supported." in text
    assert "600 of 600 (0 %)" not in text
    assert "0 of 600 (0 %)" in text


def test_a_run_that_disagrees_says_what_decided_and_what_check_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the twin finds no difference: the same run, judged by a level that few correct runs pass."""
    without_figures(monkeypatch)
    wrong = simulate(line_ring(noise={"process": [1.0, 1.0, 2.0]}))
    for run, level, words in (
        (
            claimed(wrong, line_ring()),
            0.01,
            "finds the first difference to what the file and the seed give: agent 3 at",
        ),
        (simulate(line_ring()), 0.5, "finds no difference"),
    ):
        found = dataclasses.replace(compare(run), level=level)
        tests = [dataclasses.replace(test, rejected=True) for test in found.tests]
        text = " ".join(Page(render(dataclasses.replace(found, tests=tests))).text.split())
        least = min(test.p_adjusted for test in tests)
        assert any(f"Decided by{test.name}, p = " in text for test in tests if test.p_adjusted == least)
        assert words in text


def test_lockstep_has_no_timing_and_no_runs_no_rows(tmp_path: Path) -> None:
    page = Page(_agreeing(5)[1])
    assert "Real time" not in page.text
    assert "predicted, steps of the run" in page.text
    assert "0 runs" in Page(render_runs([], tmp_path, tmp_path)).text
    with pytest.raises(InputError, match="cannot be written"):
        write_runs_page([], tmp_path, tmp_path / "none" / "index.html")


DAY = datetime(2026, 11, 25, 12, tzinfo=UTC)
EVIL = "</script><img src=http://x onerror=alert(1)>"


def test_rows_links_and_data(tmp_path: Path) -> None:
    """Newest first; the experiment of a bag is in it once, however many runs have it."""
    run = line_ring(run={"dt": 0.1, "duration": 5, "seed": 7, "start": "zero"}).simulate()
    names = ("pair 1_20261125_120000", "pair_20261126_120000")
    for day, name in zip((25, 26), names, strict=True):
        record = dataclasses.replace(run.record, started=datetime(2026, 11, day, 12, tzinfo=UTC))
        dataclasses.replace(run, record=record).save(tmp_path / "runs" / name)
    (tmp_path / "runs" / names[0] / "report.html").write_text("")
    page = Page(render_runs(list_runs(tmp_path / "runs"), tmp_path / "runs", tmp_path / "pages"))
    assert "2 runs" in page.text
    quoted = names[0].replace(" ", "%20")
    wanted = [f"../runs/{names[1]}/", f"../runs/{quoted}/", f"../runs/{quoted}/report.html"]
    assert [each for each in page.references if not each.startswith("data:")] == wanted
    data = json.loads(page.data)
    assert {each["experiment"] for each in data["runs"]} == {0}
    assert {each["versions"] for each in data["runs"]} == {1}
    assert data["documents"][0]["run.seed"] == "7"
    assert data["documents"][0]["graphs.line.path"] == "[1, 2, 3]"
    assert data["documents"][1]["numpy"] == run.record.versions["numpy"]


def test_hostile_names_of_runs(tmp_path: Path) -> None:
    evil = str(tmp_path / EVIL.replace("/", ""))
    runs = [
        RunEntry(evil, "compared", DAY + timedelta(1), name=EVIL, seed=1, verdict=EVIL, measured=1.0),
        RunEntry(str(tmp_path / "\udcff"), "foreign", DAY, problem=EVIL),
    ]
    path = tmp_path / "index.html"
    write_runs_page(runs, tmp_path, path)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert "img" not in page.tags
    assert page.tags.count("script") == 2
    assert EVIL in page.text
    assert json.loads(page.data)["runs"][0]["name"] == EVIL
    assert "default-src 'none'" in text
    assert not re.search(r"url\(|@import", text)
    assert not any(reference.startswith(("http", "//", "javascript")) for reference in page.references)


def test_long_values_are_short_and_differ(tmp_path: Path) -> None:
    for name, last in (("a", [149, 150]), ("b", [150, 149])):
        ring = {"ring": {"cycle": [*range(1, 149), *last]}}
        line_ring(graphs=ring, switching={}, run={"duration": 1, "start": "zero"}).simulate().save(tmp_path / name)
    data = json.loads(Page(render_runs(list_runs(tmp_path), tmp_path, tmp_path)).data)
    values = [each["graphs.ring.cycle"] for each in data["documents"] if "name" in each]
    assert len(set(values)) == 2
    assert all(len(value) < 300 for value in values)
