"""The page of the runs in a browser: at a desk and on a phone, light and dark, with keys alone."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from browser import FAINT, Log, Tab

from msg_analysis import Experiment
from msg_analysis.report.list_pages import write_runs_page
from msg_analysis.runs import RunEntry

DOCUMENT = {
    "name": "line",
    "graphs": {"line": {"path": [1, 2, 3]}},
}
CUT = """() => [...document.querySelectorAll("body *")].filter((one) => {
    const {left, right} = one.getBoundingClientRect();
    return one.checkVisibility() && !one.closest("thead, svg") && (right > window.innerWidth + 0.5 || left < -0.5);
}).length"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight runs of one experiment and one of another, one without a result, and a foreign folder."""
    place = tmp_path_factory.mktemp("runs")
    day = datetime(2026, 11, 25, 12, tzinfo=UTC)
    runs = []
    for i in range(9):
        name = "line" if i < 8 else "other"
        folder = place / f"{name}_2026112{i}_120000"
        if i in (6, 7):
            run = {"dt": 0.1 * (i - 5), "duration": 6, "seed": i, "start": "zero"}
            Experiment.parse(DOCUMENT | {"run": run}).simulate().save(folder)
        measured, error = 2.0 + 0.1 * i, 0.2 + 0.01 * i
        runs.append(
            RunEntry(
                str(folder),
                "compared",
                day + timedelta(days=i),
                name=name,
                seed=i,
                verdict=("agrees", "disagrees", "incomplete", "unpredicted")[i % 4],
                simulated_time=20.0,
                measured=measured,
                standard_error=error,
                low=measured - 1.96 * error,
                high=measured + 1.96 * error,
                predicted=2.1,
                z=(measured - 2.1) / error,
                report=str(folder / "report.html"),
            )
        )
    runs.append(RunEntry(str(place / "line_20261130_120000"), "not compared", day, name="line", seed=9))
    runs.append(RunEntry(str(place / ("photos" * 20)), "foreign", day, problem=f"{place}: not a bag: " + "x" * 90))
    write_runs_page(runs, place, place / "index.html")
    return place / "index.html"


def opened(tab: Tab, file: Path, width: int, scheme: str) -> tuple[Any, Log]:
    page, log = tab.open(file.as_uri(), width=width, height=800, scheme=scheme)
    page.wait_for_selector("body[data-ready=yes]")
    return page, log


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_or_pale(tab: Tab, file: Path, width: int, scheme: str) -> None:
    page, log = opened(tab, file, width, scheme)
    page.focus("#plot")
    page.keyboard.press("End")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(CUT) == 0
    assert page.evaluate(FAINT) == []
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark == (scheme == "dark")
    assert (log.complaints, log.requests) == ([], [file.as_uri()])


def test_filters_order_and_difference(tab: Tab, file: Path) -> None:
    page, log = opened(tab, file, 1280, "light")
    rows = page.locator("#runs tbody tr:visible")
    assert rows.count() == 11
    # The two newest of the experiment with most runs, and what differs between them.
    text = page.inner_text("#difference")
    error = math.hypot(0.26, 0.27)
    assert f"B − A: +0.1 ± {1.96 * error:.2g} (95 %): +{0.1 / error:.3g} standard errors" in text
    for words in ("run.dt", "run.seed", "Versions: no difference"):
        assert words in text
    assert "graphs" not in text
    assert page.inner_text("#coverage").startswith("7 of 8 intervals contain the prediction")

    page.select_option("#name", "other")
    assert (rows.count(), page.inner_text("#overlay-title")) == (1, "System error of other")
    page.select_option("#name", "")
    page.fill("#search", "line seed 3")
    assert rows.count() == 1
    page.fill("#search", "")
    page.uncheck("[value=agrees]")
    assert rows.count() == 8
    page.check("[value=agrees]")
    page.click("th[data-key=measured] button")
    assert page.locator("th[data-key=measured]").get_attribute("aria-sort") == "ascending"
    assert "line_20261120" in rows.first.inner_text()
    page.click("th[data-key=measured] button")
    assert "other_20261128" in rows.first.inner_text()
    assert "photos" in rows.last.inner_text()  # without a number it is last, either way

    page.select_option("#a", label="line_20261130_120000")
    assert "Experiment: not known" in page.inner_text("#difference")
    assert page.locator("#runs tr.chosen").count() == 2
    page.click("#swap")
    assert page.locator("#b option:checked").inner_text() == "line_20261130_120000"
    assert log.complaints == []


def test_keys_reach_everything(tab: Tab, file: Path) -> None:
    """The plot takes arrows and Enter; filters, heads of the table and boxes are stations of Tab."""
    page, log = opened(tab, file, 1280, "dark")
    reached = []
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "document.activeElement.id || document.activeElement.innerText || document.activeElement.type"
            )
        )
    for station in ("name", "search", "plot", "a", "swap", "b", "run", "system error", "checkbox", "report"):
        assert station in reached
    page.focus("#plot")
    page.keyboard.press("Home")
    assert page.inner_text("#point").startswith(
        "line_20261120_120000: 2 ± 0.39 (95 %), predicted 2.1, z = −0.5; agrees, seed 0"
    )
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert [page.locator(f"#{side} option:checked").inner_text()[:13] for side in "ab"] == [
        "line_20261120",
        "line_20261121",
    ]
    assert page.evaluate("getComputedStyle(plot).outlineStyle") == "solid"
    assert log.complaints == []
