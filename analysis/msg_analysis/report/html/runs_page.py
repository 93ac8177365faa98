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

"""The page of the runs in a folder: errors, difference of two, table; one file that loads nothing else."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from msg_analysis.bags.record_head import record_document
from msg_analysis.common.files import write_whole
from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.common.text.number_words import half_width_text, number_text, z_text
from msg_analysis.errors import InputError
from msg_analysis.inference.verdict.law_identity import flat
from msg_analysis.report.html.page_templates import page_template
from msg_analysis.runs.run_list import RunEntry

_LONGEST = 200  # characters of a value; of a longer one also a digest, so that it is seen to differ
_SIGNS = {"agrees": "✓", "disagrees": "✗", "incomplete": "?", "unpredicted": "–"}


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
    shared = _Shared()
    rows = [_row(run, place, shared) for run in newest_first]
    words = Counter(run.verdict or run.status for run in runs)
    return page_template("runs.html.j2").render(
        folder=folder.absolute().name or str(folder),
        rows=rows,
        counts=words.most_common(),
        signs=_SIGNS,
        names=[name for name, _ in Counter(run.name for run in runs if run.name is not None).most_common()],
        data={"runs": rows, "documents": shared.values, "half": HALF_WIDTH_95},
        written=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M"),
    )


class _Shared:
    """Documents that many runs have in common, each once."""

    def __init__(self) -> None:
        self.values: list[dict[str, str]] = []
        self._places: dict[str, int] = {}

    def place(self, document: Mapping[str, Any]) -> int:
        """Where in ``values`` the keys and values of a document are, as texts."""
        texts = {key: _value(value) for key, value in flat(document).items()}
        key = json.dumps(texts)
        if key not in self._places:
            self._places[key] = len(self.values)
            self.values.append(texts)
        return self._places[key]


def _value(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    if len(text) <= _LONGEST:
        return text
    digest = hashlib.sha256(text.encode(errors="replace")).hexdigest()[:8]
    return f"{text[:_LONGEST]}… ({len(text)} characters, sha256 {digest})"


def _row(run: RunEntry, place: Path, shared: _Shared) -> dict[str, Any]:
    """What the page has of a run: numbers for the plot, texts for the table."""
    experiment, versions = _record(run, shared)
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
            "measured": _number(run.measured),
            "half": _dash(half_width_text((run.low, run.high))),
            "predicted": _number(run.predicted),
            "z": _dash(z_text(run.z)),
        },
    }


def _record(run: RunEntry, shared: _Shared) -> tuple[int | None, int | None]:
    """Places of the experiment and the versions; None where they are not known."""
    try:
        document = record_document(Path(run.folder))
    except (InputError, OSError):  # no bag, or none of a run
        return None, None
    parts = (document.get("experiment"), document.get("versions"))
    experiment, versions = (shared.place(part) if isinstance(part, Mapping) else None for part in parts)
    return experiment, versions


def _link(target: Path, place: Path) -> str:
    try:
        return quote(os.path.relpath(target, place).encode(errors="surrogateescape"))
    except ValueError:  # on another drive
        return target.absolute().as_uri()


def _number(value: float | None) -> str:
    return _dash(number_text(value, 5))


def _dash(number: str) -> str:
    """With a dash where there is no number, and a minus sign."""
    return "–" if number == "-" else number.replace("-", "−")
