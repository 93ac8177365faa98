"""The pages of runs and of sweeps in a browser: at a desk and on a phone, light and dark, with keys alone."""

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from browser import CUT, FAINT, Log, Tab

from msg_analysis import Experiment
from msg_analysis.common.files import write_whole
from msg_analysis.report.list_pages import render_sweep, write_runs_page
from msg_analysis.report.look import shifted
from msg_analysis.runs import RunEntry
from msg_analysis.sweeps.grid import load_sweep
from msg_analysis.sweeps.results import axis_name, column_words

DOCUMENT = {"name": "line", "graphs": {"line": {"path": [1, 2, 3]}}}
CUT_OFF = """() => [...document.querySelectorAll("body *")].filter((one) => {
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
    assert page.evaluate(CUT_OFF) == 0
    assert page.evaluate(FAINT) == []
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark == (scheme == "dark")
    assert (log.complaints, log.requests) == ([], [file.as_uri()])


def test_runs_on_paper(tab: Tab, file: Path) -> None:
    """A table, not the cards of a phone, and nothing that asks for a click."""
    page, _ = tab.open(file.as_uri(), width=672)  # A4 within its margins
    page.emulate_media(media="print")
    assert page.locator("#runs thead").bounding_box()["height"] > 10
    assert page.evaluate("getComputedStyle(document.querySelector('#runs tbody tr')).display") == "table-row"
    assert page.locator("#point:visible, .pair:visible, .filters:visible").count() == 0
    assert page.evaluate(CUT) == []


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


EXPERIMENT = {
    "name": "made_up",
    "graphs": {"<b>$$x$$": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
    "switching": {"rates": {"<b>$$x$$": {"ring": 1}, "ring": {"<b>$$x$$": 1}}},
}


def page_of(directory: Path, over: dict[str, list[Any]], fails: Any = None) -> Path:
    """A page with made-up results; none where the last key has the value ``fails``."""
    file = directory / "made_up.yaml"
    file.write_text(yaml.safe_dump({"experiment": EXPERIMENT, "kind": "simulate", "over": over}, sort_keys=False))
    sweep = load_sweep(file)
    rows = []
    for number, point in enumerate(sweep.points, start=1):
        row = {"point": number, **point.values, "reason": None}
        if list(point.values.values())[-1] == fails:
            row["reason"] = "<i>broke</i>"
        else:
            measured = {"measured": float(number), "predicted": number + 0.25, "standard_error": 0.5}
            row |= {f"system_error.{key}": value for key, value in measured.items()}
        rows.append(row)
    return write_whole(directory / "sweep.html", render_sweep(sweep, rows, None, "made up", "agrees").encode())


KEYS = {"switching.rates.<b>$$x$$.ring": [0.1, 1, 10], "noise.loss": [0, 0.5, 0.9], "run.dt": [0.05, 0.1]}


def with_arrow(page: Any) -> None:
    """The first value of the first line, by the keyboard."""
    page.wait_for_selector("body[data-ready=yes]")
    page.focus("[data-name=lines_0_0]")
    page.keyboard.press("ArrowRight")
    said = page.inner_text("#point-lines_0_0")
    assert said.startswith("switching rate from <b>$$x$$ to ring = 0.1")
    assert "1 ± 0.98 (95 %), predicted 1.25" in said
    page.keyboard.press("Escape")
    assert page.inner_text("#point-lines_0_0") == ""


def test_one_key(tab: Tab, tmp_path: Path) -> None:
    path = page_of(tmp_path, dict(list(KEYS.items())[:1]))
    page, log = tab.open(path.as_uri(), width=390, height=800, scheme="light")
    with_arrow(page)
    assert page.locator("[data-name^=map_], #along input").count() == 0
    assert (log.complaints, log.requests) == ([], [path.as_uri()])


def test_three_keys_and_the_pointer(tab: Tab, tmp_path: Path) -> None:
    """Lines over each key; a heat map over two; beside each other for the values of a third."""
    path = page_of(tmp_path, KEYS, fails=0.1)
    page, log = tab.open(path.as_uri(), width=390, height=800, scheme="dark")
    with_arrow(page)
    assert (page.locator("[data-name^=map_]").count(), page.locator("#along input").count()) == (2, 3)
    page.check("#along input >> nth=1")
    page.wait_for_selector("[data-name=lines_1_0]")
    assert not page.is_visible("[data-name=lines_0_0]")
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate(CUT) == []
            assert page.evaluate(FAINT) == []
    page.locator("[data-name=map_0_0]").scroll_into_view_if_needed()
    page.locator("[data-name=map_0_0] .figure:not(:empty)").wait_for()
    page.wait_for_selector("body[data-ready=yes]")
    box = page.locator("[data-name=map_0_0]").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.locator(".bk-Tooltip", has_text="loss of messages").first.wait_for()
    assert "<i>broke</i>" in page.inner_text(".verdict")
    assert (log.complaints, log.requests) == ([], [path.as_uri()])


def test_names_of_keys_and_columns() -> None:
    assert axis_name("run.dt") == "step length dt [run.dt]"
    assert axis_name("noise.process[3]") == "process noise of agent 3 [noise.process[3]]"
    assert axis_name("graphs.a.path") == "graphs.a.path"
    assert column_words("node_errors[3]") == "error of agent 3"
    assert column_words("emulated.system_error") == "system error, with steps"
    assert column_words("node_errors") == "node_errors"


@pytest.mark.parametrize("logarithmic", [False, True])
def test_points_of_series_side_by_side(logarithmic: bool) -> None:
    """No two at the same place, none past the middle between two values."""
    values = np.array([1.0, 2.0, 4.0])
    drawn = np.array([shifted(values, values, i, 8, logarithmic=logarithmic) for i in range(8)])
    assert (np.diff(drawn, axis=0) > 0).all()
    middles = np.sqrt(values[1:] * values[:-1]) if logarithmic else (values[1:] + values[:-1]) / 2
    assert (drawn[:, :-1] < middles).all()
    assert (drawn[:, 1:] > middles).all()
    np.testing.assert_array_equal(shifted(values, values, 0, 1, logarithmic=logarithmic), values)
