# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""For tests of other packages: a run must agree with its prediction, or have a good number often enough."""

from __future__ import annotations

from pathlib import Path

from msg_analysis.inference.acceptance import Acceptance, Claim, accept
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.pool import compare
from msg_analysis.model.run import Run

__all__ = ["Acceptance", "Claim", "accept", "assert_agrees"]


def assert_agrees(*runs: Run | str | Path, level: float = 0.001, report: str | Path | None = None) -> Comparison:
    """Fail unless a run, or several together, agree with the prediction.

    A correct run fails with a probability of at most ``level``: fix the seed, or choose a small level.

    Parameters
    ----------
    *runs
        runs, or paths of their bags
    level
        probability of a false failure, all tests together; above 0, at most 0.5
    report
        a file (HTML) for a page that shows the comparison, whatever comes of it

    Returns
    -------
    Comparison
        for more assertions

    Raises
    ------
    AssertionError
        the verdict is not "agrees"; names the tests that are rejected, and the causes that were found
    InputError, BagError
        as of :func:`msg_analysis.compare`
    """
    comparison = compare(*runs, level=level)
    if report is not None:
        from msg_analysis.report.page import write_report  # here, since it imports much more than a test needs

        Path(report).parent.mkdir(parents=True, exist_ok=True)
        write_report(comparison, Path(report))
    if comparison.verdict != "agrees":
        rejected = [f"{test.name} (adjusted p {test.p_adjusted:.3g})" for test in comparison.tests if test.rejected]
        missing = f"{comparison.trajectory.completeness.missing} states are missing"
        causes = [cause.words for cause in comparison.causes]
        reasons = [comparison.unpredicted or ", ".join(rejected) or missing, *causes]
        raise AssertionError(f"{comparison!r}: {'; '.join(reasons)}")
    return comparison
