# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The end of a run on the command line: verdict, output, exit code."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from msg_agents.terminal import Interruption
from msg_analysis.cli.console import complain, print_json, result_console
from msg_analysis.common.resources import watched
from msg_analysis.errors import ExitCode

if TYPE_CHECKING:
    from msg_agents.run.result import ReportWhen, RunResult


def finish(
    result: RunResult,
    as_json: bool,
    say: Callable[[dict[str, Any], Path | None], None] = lambda *_: None,
    *,
    interruption: Interruption,
    analyse: bool = True,
    report: ReportWhen = "always",
    verbose: bool = False,
    **limits: float,
) -> None:
    """Print the failures, compare what was recorded (until a signal), show the result, and exit with its code."""
    for line in result.failures:
        complain(line, "failed:")
    if analyse and not result.interrupted:
        # While signals are kept: an exception in the middle of an import may become another one.
        from msg_agents.run.result import conclude
        from msg_analysis.cli.console import WorkProgress

        progress = WorkProgress()
        try:
            with interruption.let_through(), progress, watched(progress):
                conclude(result, report, **limits)
        except KeyboardInterrupt:
            result.interrupt(signal.SIGINT, "while the run was compared with the prediction")
            complain(result.failures[0], "failed:")
    say(_ending(result), result.report)
    _show(result, as_json, verbose)
    for line in result.not_kept:
        complain(line, "not kept:")
    if result.incomplete or (analyse and result.bag is not None and result.comparison is None):
        sys.exit(ExitCode.INCOMPLETE)
    code = ExitCode.FINE if result.comparison is None else result.comparison.exit_code
    sys.exit(code or (ExitCode.BAD_INPUT if result.not_kept else code))


def _ending(result: RunResult) -> dict[str, Any]:
    """Text and verdict of the end of a run, for the live page."""
    if result.failures:
        return {"text": f"The run has ended early: {result.failures[0]}", "verdict": "incomplete"}
    if result.comparison is None:
        return {"text": "The run has ended.", "verdict": None}
    verdict = result.comparison.verdict
    words = {"incomplete": "the data are incomplete", "unpredicted": "there is no prediction", "late": "it was late"}
    outcome = words.get(verdict, f"it {verdict} with the prediction")
    return {"text": f"The run has ended; {outcome}.", "verdict": verdict}


def _show(result: RunResult, as_json: bool, verbose: bool) -> None:
    """Print the result on stdout; of an interrupted run, also write result.json."""
    if result.interrupted:
        result.write()
    document = result.to_json()
    if as_json:
        print_json(document)
        return
    if result.comparison is not None:
        from msg_analysis.report.comparison_text import print_comparison

        print_comparison(document, result_console(), verbose=verbose)
    for line in (result.channel or {}).get("findings", []):
        click.echo(f"Channel: {line}")
    if result.comparison is not None:
        click.echo(f"bag:    {document['bag']}")
        if result.report:
            click.echo(f"report: {result.report}")
    elif document["bag"]:
        click.echo(f"bag: {document['bag']}")
        if result.interrupted and result.reached > 0:
            click.echo(f"To compare what it holds with the prediction: msg-analysis compare {document['bag']}")
    if result.rate:
        click.echo(f"{result.rate:.0f} steps/s over {result.wall_time:.1f} s")
