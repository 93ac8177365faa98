"""How often the comparison is right: ``make calibrate`` writes the tables between the marks of docs/calibration.md.

Simulates runs with the offline twin. Runs that follow their law say how often intervals cover the truth and how often
"disagrees" is a false alarm; runs in which one thing is wrong say how often that is found, and how often the first
cause that is blamed is the right one. Results of single runs are kept in build/calibration, in a directory of this very
version of the code, so that an interrupted calibration goes on where it was.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import calibration_any_time as any_time
from calibration_laws import FALSE, LONG, MESSAGES, SHORT, TRUE, line_ring
from calibration_runs import ROOT, run_all
from calibration_tables import complaints, message_tables, tables

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.pool import compare
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import new_record, simulate

PAGE = ROOT / "docs/calibration.md"


@functools.cache
def experiment(case: str) -> tuple[Experiment, Experiment]:
    """What is run, and what the record claims."""
    if case in TRUE or case in SHORT or case in MESSAGES:
        true = Experiment.parse((TRUE | SHORT | MESSAGES)[case])
        return true, true
    return Experiment.parse(FALSE[case][0]), Experiment.parse(line_ring(**LONG))


def one_run(job: tuple[str, int], _stopping: Callable[[], bool]) -> dict[str, Any]:
    """Simulate and compare a run; what is kept of it."""
    case, number = job
    # Runs of different experiments with equal seeds would have the same noise.
    seed = 100_000 * [*TRUE, *FALSE, *SHORT, *MESSAGES].index(case) + number
    true, claimed = (each.with_run(seed=seed) for each in experiment(case))
    record = new_record(claimed)
    trajectory = simulate(true, record=RunRecord(record.run, true, record.start))
    lost = trajectory.lost if claimed.noise.loss.any else None  # messages that are ignored are not in the log
    comparison = compare(dataclasses.replace(trajectory, record=record, lost=lost))
    return summary(case, comparison)


def summary(case: str, comparison: Comparison) -> dict[str, Any]:
    """What is kept of a comparison; coverage is None where there is no interval."""
    predicted, batch, given, order = (
        comparison.system_error.predicted,
        comparison.batch,
        comparison.given,
        comparison.order,
    )
    assert predicted is not None
    assert batch is not None
    kept: dict[str, Any] = {
        "system": covers(comparison.system_error),
        "nodes": [covers(node) for node in comparison.node_errors],
        # In real time the errors themselves are those given the log.
        "given": covers(given.system_error if given else comparison.system_error),
        "given_nodes": [covers(node) for node in (given.node_errors if given else comparison.node_errors)],
        "ratio": given.variance_ratio if given else None,
        "batch": batch[0] <= predicted <= batch[1],
        "disagrees": comparison.verdict == "disagrees",
        "order": order is not None and any(pair.predicted is False for pair in order.distinctions),
        "p": {test.name: test.p for test in comparison.tests},
    }
    if case in FALSE and comparison.causes:
        first = comparison.causes[0]
        said = (first.kind, first.agent, list(first.link) if first.link else None)
        kept |= {"right": said == FALSE[case][1], "said": first.words, "causes": len(comparison.causes)}
    return kept


def covers(estimate: Estimate) -> bool | None:
    """Whether the interval holds what is predicted; None without noise, or where the run is too short for one."""
    low, high = estimate.interval
    if estimate.z is None or low is None or high is None:
        return None
    assert estimate.predicted is not None
    return low <= estimate.predicted <= high


def write(text: str, page: Path, marks: str) -> None:
    """Put the tables between the marks of a page."""
    begin, end = f"<!-- {marks}: begin, written by make calibrate -->\n", f"<!-- {marks}: end -->\n"
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        sys.exit(f"error: {page}: no marks to write the tables between")
    page.write_text(re.sub(f"{begin}.*?{end}", lambda _: f"{begin}\n{text}\n{end}", old, flags=re.S), encoding="utf-8")


def main() -> None:
    """Run everything, print the tables, and write them where wanted."""
    parser = argparse.ArgumentParser(description="Coverage, false alarms, power and causes of the comparison.")
    parser.add_argument("--runs", type=int, default=1000, help="of each law that is right; 1000 by default")
    parser.add_argument("--wrong-runs", type=int, default=100, help="of each law that is wrong; 100 by default")
    parser.add_argument("--any-time-runs", type=int, default=2000, help="watched all the time; 2000 by default")
    parser.add_argument("--messages", type=int, help="so many runs with noise and losses, and nothing else")
    parser.add_argument("--any-time", action="store_true", help="only the runs that are watched all the time")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", action="store_true", help=f"write the tables into {PAGE.relative_to(ROOT)}")
    arguments = parser.parse_args()
    found: list[str] = []
    if not arguments.any_time:
        runs = dict.fromkeys(TRUE | SHORT, arguments.runs) | dict.fromkeys(FALSE, arguments.wrong_runs)
        if arguments.messages:
            runs = dict.fromkeys(MESSAGES, arguments.messages)
        results = run_all(one_run, runs, "runs", arguments.processes)
        text = message_tables(results) if arguments.messages else tables(results)
        print(text)
        if arguments.write and not arguments.messages:
            write(text, PAGE, "calibration")
        found += complaints(results)
    if not arguments.messages:
        results = run_all(
            any_time.one_run, dict.fromkeys(any_time.CASES, arguments.any_time_runs), "any_time", arguments.processes
        )
        text = any_time.table(results)
        print(text)
        if arguments.write:
            write(text, PAGE, "evidence at any time")
        found += any_time.complaints(results)
    print("\n".join(found), file=sys.stderr)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
