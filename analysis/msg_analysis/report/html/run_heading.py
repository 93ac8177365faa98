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

"""The head of the page: what tells this run apart from others, and the title of the tab."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

from msg_analysis.common.text.number_words import counted
from msg_analysis.inference.verdict.comparison import Comparison
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.record import RunRecord

SYMBOLS = {"agrees": "✓", "disagrees": "✗", "incomplete": "?", "unpredicted": "–"}
_SHOWN_SEEDS = 8


def page_title(comparison: Comparison) -> str:
    """The title of the tab, what differs between runs first: verdict, name, seed, date."""
    records = _records(comparison)
    parts = [records[0].experiment.name]
    if len(records) > 1:
        parts.append(counted(len(records), "run"))
    parts += [_seeds(records), _dates(records)[0]]
    return f"{SYMBOLS[comparison.verdict]} {', '.join(parts)}: {comparison.verdict}"


def run_facts(comparison: Comparison, wall_time: float | None) -> list[tuple[str, str]]:
    """Seed, date, duration and pace of the run or the runs; ``wall_time`` [s] if it is known."""
    records = _records(comparison)
    experiment = records[0].experiment
    facts = [("seed" if len(records) == 1 else "seeds", _seeds(records).partition(" ")[2])]
    dates = _dates(records)
    facts.append(("date", " to ".join(dict.fromkeys((dates[0], dates[-1]))) + " UTC"))
    durations = sorted({record.experiment.run.duration for record in records})
    time = " to ".join(f"{each:g}" for each in dict.fromkeys((durations[0], durations[-1])))
    steps = f", {counted(experiment.steps, 'step')} of {experiment.step_length:g}" if len(durations) == 1 else ""
    each = " each" if len(records) > 1 else ""
    facts.append(("duration", f"{time} units of time{steps}{each}" + (f", in {wall_time:.3g} s" if wall_time else "")))
    facts.append(("pace", _pace(experiment)))
    return facts


def _records(comparison: Comparison) -> list[RunRecord]:
    pool = comparison.pool
    return [member.record for member in pool.members] if pool else [comparison.trajectory.record]


def _seeds(records: Sequence[RunRecord]) -> str:
    seeds = [str(record.experiment.run.seed) for record in records]
    shown = ", ".join(seeds[:_SHOWN_SEEDS]) + (", …" if len(seeds) > _SHOWN_SEEDS else "")
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {shown}"


def _dates(records: Sequence[RunRecord]) -> list[str]:
    """Ascending, to the minute."""
    dates = sorted(record.started for record in records)
    return [date.astimezone(datetime.UTC).strftime("%Y-%m-%d %H:%M") for date in dates]


def _pace(experiment: ValidExperiment) -> str:
    run = experiment.run
    if run.pace == "lockstep":
        return "lockstep"
    return f"real time, {run.speed:g} units of time per second"
