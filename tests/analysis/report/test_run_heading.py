"""The head of the report: what tells runs apart."""

from __future__ import annotations

import dataclasses
import datetime

import pytest

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.verdict import compare, compare_pooled
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.report.page import page_title, run_facts
from msg_analysis.twin.simulate import new_record, simulate

DOCUMENT = {
    "name": "pair",
    "graphs": {"pair": {"path": [1, 2]}},
    "run": {"dt": 0.05, "duration": 20, "seed": 3, "start": "zero"},
}
NOON = datetime.datetime(2026, 11, 25, 12, 0, 59, tzinfo=datetime.UTC)


def run(started: datetime.datetime = NOON, **changes: object) -> Run:
    experiment = Experiment.parse(DOCUMENT | {"run": DOCUMENT["run"] | changes})  # type: ignore[operator]
    found = simulate(experiment)
    return dataclasses.replace(found, record=dataclasses.replace(found.record, started=started))


def test_one_run() -> None:
    comparison = compare(run())
    assert page_title(comparison) == f"✓ pair, seed 3, 2026-11-25 12:00: {comparison.verdict}"
    assert run_facts(comparison, 12.34) == [
        ("seed", "3"),
        ("date", "2026-11-25 12:00 UTC"),
        ("duration", "20 units of time, 400 steps of 0.05, in 12.3 s"),
        ("pace", "lockstep"),
    ]


def test_real_time() -> None:
    comparison = compare(run(pace="realtime", speed=5))
    assert [name for name, _ in run_facts(comparison, None)] == ["seed", "date", "duration", "pace"]
    assert run_facts(comparison, None)[-1] == ("pace", "real time, 5 units of time per second")


def test_several_runs() -> None:
    later = NOON + datetime.timedelta(days=1)
    comparison = compare_pooled([("a", run(later)), ("b", run(seed=4))])
    assert page_title(comparison).startswith("✓ pair, 2 runs, seeds 3, 4, 2026-11-25 12:00: ")
    facts = dict(run_facts(comparison, None))
    assert facts["seeds"] == "3, 4"
    assert facts["date"] == "2026-11-25 12:00 to 2026-11-26 12:00 UTC"
    assert facts["duration"] == "20 units of time, 400 steps of 0.05 each"


def test_the_record_keeps_its_date() -> None:
    record = new_record(Experiment.parse(DOCUMENT))
    again = RunRecord.from_json(record.to_json(), "here")
    assert again.started == record.started
    assert again.to_json() == record.to_json()
    local = record.to_json().replace(record.started.isoformat(), "2026-11-25T13:00:59+01:00")
    assert RunRecord.from_json(local, "here").started == NOON
    for wrong in (
        record.to_json().replace(record.started.isoformat(), "yesterday"),
        record.to_json().replace('"started"', '"other"'),
    ):
        with pytest.raises(InputError, match="not a run record"):
            RunRecord.from_json(wrong, "here")
