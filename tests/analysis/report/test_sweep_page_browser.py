"""The page of a sweep in a browser: no complaint, no request, values by pointer and by keys, any width."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from browser import CUT, FAINT, Tab

from msg_analysis.report.figures import shifted
from msg_analysis.report.list_pages import write_sweep_page
from msg_analysis.sweep.grid import load_sweep
from msg_analysis.sweep.results import axis_name, column_words

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
    return write_sweep_page(sweep, rows, None, "made up", "agrees", directory)


@pytest.mark.parametrize("keys", [1, 3])
def test_keys_and_pointer(tab: Tab, tmp_path: Path, keys: int) -> None:
    """Lines over each key; a heat map over two; beside each other for the values of a third."""
    every = {"switching.rates.<b>$$x$$.ring": [0.1, 1, 10], "noise.loss": [0, 0.5, 0.9], "run.dt": [0.05, 0.1]}
    over = dict(list(every.items())[:keys])
    path = page_of(tmp_path, over, fails=0.1 if keys == 3 else None)
    page, log = tab.open(path.as_uri(), width=390, height=800, scheme="dark" if keys == 3 else "light")
    page.wait_for_selector("body[data-ready=yes]")
    assert page.locator("[data-name^=map_]").count() == {1: 0, 3: 2}[keys]
    assert page.locator("#along input").count() == {1: 0, 3: 3}[keys]
    page.focus("[data-name=lines_0_0]")
    page.keyboard.press("ArrowRight")
    said = page.inner_text("#point-lines_0_0")
    assert said.startswith("switching rate from <b>$$x$$ to ring = 0.1")
    assert "1 ± 0.98 (95 %), predicted 1.25" in said
    page.keyboard.press("Escape")
    assert page.inner_text("#point-lines_0_0") == ""
    if keys > 1:
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
    assert log.complaints == []
    assert log.requests == [path.as_uri()]


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
