# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The page of a sweep: lines over each key, heat maps over two, all numbers; one file that loads nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bokeh.models import UIElement

from msg_analysis.common.files import write_whole
from msg_analysis.common.text.number_words import half_width_text, number_text
from msg_analysis.report.html.packed_figures import pack
from msg_analysis.report.html.page_templates import page_template
from msg_analysis.report.html.plots import colours, sweep_plots
from msg_analysis.sweep.axis_names import axis_name, column_words, key_words
from msg_analysis.sweep.figure_series import Picture, picture, several_values, value_text
from msg_analysis.sweep.plan import Sweep
from msg_analysis.sweep.table import Row

_OPEN_TABLE = 30  # most rows with which the table is open at first


def write_sweep_page(
    sweep: Sweep, rows: Sequence[Row], column: str | None, summary: str, verdict: str | None, directory: Path
) -> Path:
    """Write ``sweep.html``, whole or not at all. Arguments as in ``render_sweep``."""
    return write_whole(directory / "sweep.html", render_sweep(sweep, rows, column, summary, verdict).encode())


def render_sweep(
    sweep: Sweep,
    rows: Sequence[Row],  # of ``rows_of``
    column: str | None,  # what is drawn, as in ``picture``
    summary: str,  # how many points, and what came of them
    verdict: str | None,  # of all runs together; None where nothing is compared
) -> str:
    """The page as HTML text."""
    keys = several_values(sweep) or [sweep.keys[0]]
    pictures = {key: picture(sweep, rows, column, key) for key in keys}
    first = pictures[keys[0]]
    models: dict[str, UIElement] = {}
    lines = {key: _figures(models, shown, "lines", number) for number, (key, shown) in enumerate(pictures.items())}
    maps = _figures(models, first, "map", 0) if first.series[0].values else []
    plots, packed = pack(models)
    places = [(series, place) for series in first.series for place in series.places]
    return page_template("sweep.html.j2").render(
        sweep=sweep,
        column=column_words(first.y, sweep.names),
        measured=first.measured,
        referred=any(place.reference is not None for _, place in places),
        dashed=any(sweep_plots.dashed(shown) for shown in pictures.values()),
        summary=summary,
        verdict=verdict,
        lines=lines,
        keys={key: sweep_plots.key_of_lines(shown) for key, shown in pictures.items()},
        markers=list(sweep_plots.MARKERS.values()),
        line_colours=colours.LINES,
        by_factors=sweep_plots.by_factors(first),
        maps=maps,
        axis_names={key: axis_name(key, sweep.names) for key in keys},
        values=[(axis_name(key, sweep.names), _values(sweep.spec.over[key])) for key in sweep.keys],
        first=first,
        second=first.series[0].values[0][0] if first.series[0].values else None,
        hidden_panels=max(0, len(sweep_plots.panels(first)) - sweep_plots.MOST_PANELS),
        hidden_lines=any(
            len(panel.series) > sweep_plots.MOST_LINES
            for shown in pictures.values()
            for panel in sweep_plots.panels(shown)
        ),
        most_lines=sweep_plots.MOST_LINES,
        most_panels=sweep_plots.MOST_PANELS,
        heads=[key_words(key, sweep.names) for key in (first.x, *(key for key, _ in first.series[0].values))],
        table=[_row(first, series.values, place) for series, place in places],
        table_open=len(places) <= _OPEN_TABLE,
        failures=list(dict.fromkeys(f"point {row['point']}: {row['reason']}" for row in rows if row.get("reason"))),
        dark=colours.DARK,
        plots=plots,
        packed=packed,
    )


def _figures(models: dict[str, UIElement], shown: Picture, kind: str, number: int) -> list[tuple[str, str]]:
    """Add the figures of a picture to ``models``; their names and titles."""
    draw = sweep_plots.lines if kind == "lines" else sweep_plots.heat_map
    found = []
    for place, panel in enumerate(sweep_plots.panels(shown)[: sweep_plots.MOST_PANELS]):
        name = f"{kind}_{number}_{place}"
        models[name] = draw(shown, panel, name)
        found.append((name, panel.title))
    return found


def _values(values: Sequence[Any]) -> str:
    """The values of a key, in words."""
    words = [value_text(value) for value in values]
    return f"{len(words)} values, {words[0]} to {words[-1]}" if len(words) > 8 else ", ".join(words)


def _row(shown: Picture, values: Sequence[tuple[str, Any]], place: Any) -> Mapping[str, Any]:
    return {
        "keys": [value_text(place.x), *(value_text(value) for _, value in values)],
        "value": number_text(place.value),
        "half": half_width_text((place.low, place.high)),
        "expected": number_text(place.predicted if shown.measured else place.reference),
        "lost": place.value is None,
    }
