# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""For tests of other packages: a run must agree with its prediction, or have a good number often enough."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from msg_analysis.bags.log_map import load_map
from msg_analysis.bags.mapped_log import read_log
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.acceptance import Acceptance, Claim, accept
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.log_verdict import LogComparison
from msg_analysis.inference.pool import compare
from msg_analysis.model.log import Log
from msg_analysis.model.run import Run

Compared = TypeVar("Compared", Comparison, LogComparison)

__all__ = ["Acceptance", "Claim", "accept", "assert_agrees"]


def assert_agrees(
    *runs: Run | Log | str | Path,
    law: Experiment | str | Path | None = None,
    map: str | Path | None = None,
    level: float = 0.001,
    report: str | Path | None = None,
) -> Comparison | LogComparison:
    """Fail unless a run, or several together, agree with the prediction.

    A correct run fails with a probability of at most ``level``: fix the seed, or choose a small level.

    Parameters
    ----------
    *runs
        runs, or paths of their bags; or one log of other robots
    law, map
        of a log of others: the experiment that it should follow, and the file that says where its states are
    level
        probability of a false failure, all tests together; above 0, at most 0.5
    report
        a file (HTML) for a page that shows the comparison, whatever comes of it

    Returns
    -------
    Comparison | LogComparison
        for more assertions

    Raises
    ------
    AssertionError
        the verdict is not "agrees"; names the tests that are rejected, and the causes that were found
    InputError, BagError
        as of :func:`msg_analysis.compare`
    """
    if law is not None or any(isinstance(run, Log) for run in runs):
        return _assert_law(*runs, law=law, map=map, level=level, report=report)
    comparison = compare(*(run for run in runs if not isinstance(run, Log)), level=level)
    if report is not None:
        from msg_analysis.report.page import write_report  # here, since it imports much more than a test needs

        Path(report).parent.mkdir(parents=True, exist_ok=True)
        write_report(comparison, Path(report))
    missing = f"{comparison.trajectory.completeness.missing} states are missing"
    return _agreed(comparison, comparison.unpredicted, missing)


def _agreed(comparison: Compared, reason: str | None = None, otherwise: str = "") -> Compared:
    """The comparison; AssertionError: it does not agree, for this ``reason``, rejected tests, or ``otherwise``."""
    if comparison.verdict == "agrees":
        return comparison
    rejected = [f"{test.name} (adjusted p {test.p_adjusted:.3g})" for test in comparison.tests if test.rejected]
    causes: list[str] = [cause.words for cause in comparison.causes]
    raise AssertionError(f"{comparison!r}: {'; '.join([reason or ', '.join(rejected) or otherwise, *causes])}")


def _assert_law(
    *logs: Run | Log | str | Path,
    law: Experiment | str | Path | None,
    map: str | Path | None,
    level: float,
    report: str | Path | None,
) -> LogComparison:
    if len(logs) != 1 or isinstance(logs[0], Run):
        raise InputError(f"{len(logs)} logs: expected one log or its path with a law")
    log = logs[0]
    if not isinstance(log, Log):
        if law is None or map is None:
            raise InputError("map: missing: expected the file that says where the states in the log are")
        law = law if isinstance(law, Experiment) else Experiment.load(law)
        log = read_log(Path(log), load_map(Path(map)), law, Path(map).parent)
    comparison = log.compare(level=level)
    if report is not None:
        from msg_analysis.report.log_page import write_log_report  # here, as above

        Path(report).parent.mkdir(parents=True, exist_ok=True)
        write_log_report(comparison, report)
    return _agreed(comparison)
