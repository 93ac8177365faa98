# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Pages of many runs: sweeps, folders of runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from bokeh.models import UIElement

from msg_analysis.bags.reading import record_document
from msg_analysis.common.files import write_whole
from msg_analysis.common.text import HALF_WIDTH_95, half_width_text, number_text, z_text
from msg_analysis.errors import InputError
from msg_analysis.inference.comparison import flat
from msg_analysis.report import plot_style, sweep_plots
from msg_analysis.report.page import SYMBOLS, minus_sign, pack, page_template
from msg_analysis.runs import RunEntry
from msg_analysis.sweeps.grid import SweepGrid
from msg_analysis.sweeps.results import (
    Picture,
    Row,
    axis_name,
    column_words,
    key_words,
    picture,
    several_values,
    value_text,
)

_OPEN_TABLE = 30  # most rows with which the table is open at first


def render_sweep(
    sweep: SweepGrid,
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
    values = []
    for key in sweep.keys:
        words = [value_text(value) for value in sweep.spec.over[key]]
        several = f"{len(words)} values, {words[0]} to {words[-1]}" if len(words) > 8 else ", ".join(words)
        values.append((axis_name(key, sweep.names), several))
    table = [
        {
            "keys": [value_text(place.x), *(value_text(value) for _, value in series.values)],
            "value": number_text(place.value),
            "half": half_width_text((place.low, place.high)),
            "expected": number_text(place.predicted if first.measured else place.reference),
            "lost": place.value is None,
        }
        for series in first.series
        for place in series.places
    ]
    return page_template("sweep.html.j2").render(
        sweep=sweep,
        column=column_words(first.y, sweep.names),
        referred=any(place.reference is not None for place in first.places),
        dashed=any(sweep_plots.dashed(shown) for shown in pictures.values()),
        summary=summary,
        verdict=verdict,
        lines=lines,
        keys={key: sweep_plots.key_of_lines(shown) for key, shown in pictures.items()},
        markers=list(sweep_plots.MARKERS.values()),
        style=plot_style,
        by_factors=sweep_plots.by_factors(first),
        maps=maps,
        axis_names={key: axis_name(key, sweep.names) for key in keys},
        values=values,
        first=first,
        second=first.series[0].values[0][0] if first.series[0].values else None,
        panels=len(sweep_plots.panels(first)),
        longest=max(len(panel.series) for shown in pictures.values() for panel in sweep_plots.panels(shown)),
        most_lines=sweep_plots.MOST_LINES,
        most_panels=sweep_plots.MOST_PANELS,
        heads=[key_words(key, sweep.names) for key in (first.x, *(key for key, _ in first.series[0].values))],
        table=table,
        table_open=len(table) <= _OPEN_TABLE,
        failures=list(dict.fromkeys(f"point {row['point']}: {row['reason']}" for row in rows if row.get("reason"))),
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


_Documents = dict[str, tuple[int, dict[str, str]]]  # each once, although many runs have it: place and texts, by JSON
_LONGEST = 200  # characters of a value; of a longer one also a digest, so that it is seen to differ


def write_runs_page(runs: Sequence[RunEntry], folder: Path, path: Path) -> None:
    """Write the page of the runs of a folder, whole or not at all; InputError if that fails."""
    html = render_runs(runs, folder, path.parent)
    try:
        write_whole(path, html.encode(errors="replace"))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place with --page") from error


def render_runs(runs: Sequence[RunEntry], folder: Path, place: Path) -> str:
    """The page as HTML text; ``place``: the folder it will be in, to which its links are relative."""
    newest_first = sorted(runs, key=lambda run: run.date, reverse=True)
    documents: _Documents = {}
    rows = [_run_row(run, place, documents) for run in newest_first]
    words = Counter(run.verdict or run.status for run in runs)
    return page_template("runs.html.j2").render(
        folder=folder.absolute().name or str(folder),
        rows=rows,
        counts=words.most_common(),
        signs=SYMBOLS,
        names=[name for name, _ in Counter(run.name for run in runs if run.name is not None).most_common()],
        data={"runs": rows, "documents": [texts for _, texts in documents.values()], "half": HALF_WIDTH_95},
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def _value(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    if len(text) <= _LONGEST:
        return text
    digest = hashlib.sha256(text.encode(errors="replace")).hexdigest()[:8]
    return f"{text[:_LONGEST]}… ({len(text)} characters, sha256 {digest})"


def _run_row(run: RunEntry, place: Path, documents: _Documents) -> dict[str, Any]:
    """What the page has of a run: numbers for the plot, texts for the table."""
    experiment, versions = _record(run, documents)
    return run.to_json() | {
        "id": Path(run.folder).name,
        "word": run.verdict or run.status,
        "link": _link(Path(run.report), place) if run.report else None,
        "href": _link(Path(run.folder), place),
        "when": f"{run.date:%Y-%m-%d %H:%M}",
        "experiment": experiment,
        "versions": versions,
        "texts": {
            "seed": "–" if run.seed is None else str(run.seed),
            "measured": minus_sign(number_text(run.measured, 5)),
            "half": minus_sign(half_width_text((run.low, run.high))),
            "predicted": minus_sign(number_text(run.predicted, 5)),
            "z": minus_sign(z_text(run.z)),
        },
    }


def _record(run: RunEntry, documents: _Documents) -> list[int | None]:
    """Places of the experiment and the versions among the documents; None where they are not known."""
    try:
        record = record_document(Path(run.folder))
    except (InputError, OSError):  # no bag, or none of a run
        return [None, None]
    parts = (record.get("experiment"), record.get("versions"))
    return [_place(part, documents) if isinstance(part, Mapping) else None for part in parts]


def _place(document: Mapping[str, Any], documents: _Documents) -> int:
    texts = {key: _value(value) for key, value in flat(document).items()}
    return documents.setdefault(json.dumps(texts), (len(documents), texts))[0]


def _link(target: Path, place: Path) -> str:
    try:
        return quote(os.path.relpath(target, place).encode(errors="surrogateescape"))
    except ValueError:  # on another drive
        return target.absolute().as_uri()
