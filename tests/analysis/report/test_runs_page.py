"""The page of the runs: valid, self-contained, with links that hold, and safe with any name."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path

import pytest

from msg_analysis import Experiment, InputError
from msg_analysis.report.list_pages import render_runs, write_runs_page
from msg_analysis.runs import RunEntry, list_runs

DAY = datetime(2026, 11, 25, 12, tzinfo=UTC)
EVIL = "</script><img src=http://x onerror=alert(1)>"


class Page(HTMLParser):
    """Texts, references and tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.text, self.data = "", ""
        self._inside = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "action", "data")]
        self._inside = tag if tag != "script" else f"script {dict(attrs).get('type')}"

    def handle_data(self, data: str) -> None:
        if self._inside == "script application/json":
            self.data += data
        elif not self._inside.startswith(("script", "style")):
            self.text += data


def test_rows_links_and_data(tmp_path: Path) -> None:
    """Newest first; the experiment of a bag is in it once, however many runs have it."""
    document = {"name": "pair", "graphs": {"line": {"path": [1, 2, 3]}}, "run": {"dt": 0.1, "duration": 5, "seed": 7}}
    run = Experiment.parse(document | {"run": document["run"] | {"start": "zero"}}).simulate()
    names = ("pair 1_20261125_120000", "pair_20261126_120000")
    for name in names:
        run.save(tmp_path / "runs" / name)
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


def test_hostile_names(tmp_path: Path) -> None:
    runs = [
        RunEntry(
            str(tmp_path / EVIL.replace("/", "")),
            "compared",
            DAY + timedelta(1),
            name=EVIL,
            seed=1,
            verdict=EVIL,
            measured=1.0,
        ),
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
    document = {"name": "ring", "graphs": {"ring": {"cycle": list(range(1, 151))}}, "run": {"dt": 0.1, "duration": 1}}
    for name, last in (("a", [149, 150]), ("b", [150, 149])):
        document["graphs"] = {"ring": {"cycle": [*range(1, 149), *last]}}
        document["run"] = {"dt": 0.1, "duration": 1, "start": "zero"}
        Experiment.parse(document).simulate().save(tmp_path / name)
    data = json.loads(Page(render_runs(list_runs(tmp_path), tmp_path, tmp_path)).data)
    values = [each["graphs.ring.cycle"] for each in data["documents"] if "name" in each]
    assert len(set(values)) == 2
    assert all(len(value) < 300 for value in values)


def test_no_runs_and_no_place(tmp_path: Path) -> None:
    assert "0 runs" in Page(render_runs([], tmp_path, tmp_path)).text
    with pytest.raises(InputError, match="cannot be written"):
        write_runs_page([], tmp_path, tmp_path / "none" / "index.html")
