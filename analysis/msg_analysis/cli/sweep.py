# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The command ``sweep`` of ``msg-analysis``, and the networks of ``figures --emulate``: many runs or predictions."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from msg_analysis.cli.console import (
    complain,
    examples,
    plain_matplotlib,
    print_json,
    print_note,
    print_notes,
    print_text,
    result_console,
)
from msg_analysis.cli.options import YAML, choice_option, json_option, out_option
from msg_analysis.errors import ExitCode, InputError, killed_by

if TYPE_CHECKING:
    from msg_analysis.sweeps.points import Job, JobResults
    from msg_analysis.sweeps.results import ResultStore
    from msg_analysis.sweeps.workers import OtherSoftware


BOTH = "--workers: not together with --scheduler, which has workers of its own: give one of them"

other_software = choice_option(
    "--other-software",
    ["refuse", "redo", "keep"],
    "What to do with results that other versions made.",
    default="refuse",
)


@click.command(
    epilog=examples(
        "msg-analysis sweep rates.yaml",
        "msg-analysis sweep rates.yaml --workers 4 --json > rates.json",
        "msg-analysis sweep rates.yaml --scheduler tcp://10.0.0.1:8786",
    )
)
@click.argument("sweep_file", metavar="SWEEP", type=YAML)
@out_option("DIR", "Directory of the results.", show_default="sweeps/<name>")
@click.option(
    "--workers",
    type=click.IntRange(1),
    metavar="N",
    show_default="one for each CPU; one where networks run",
    help="Worker processes; each network needs a machine of its own.",
)
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Use the workers of this Dask scheduler instead.")
@click.option("--column", metavar="NAME", show_default="system_error", help="Column of the tables to draw and list.")
@click.option("--retry", is_flag=True, help="Repeat failed points.")
@other_software
@click.option("--keep-bags", is_flag=True, help="Also keep the bags of networks that agree with the prediction.")
@json_option
@click.pass_context
def sweep(
    context: click.Context,
    /,
    sweep_file: Path,
    *,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    column: str | None,
    keep_bags: bool,
    as_json: bool,
    **how: Any,
) -> None:
    """Predict, simulate or run at many values of the keys.

    The file SWEEP describes them. Results are kept: after an interruption, the same command continues. Tables
    (Parquet, CSV, JSON), a figure and an interactive page are written next to them.

    Exit code 0: success, 1: some run disagrees with its prediction, all runs tested together, 3: some point has no
    result.
    """
    if workers and scheduler:
        raise InputError(BOTH)
    from msg_analysis.cli.console import SweepProgress
    from msg_analysis.sweeps.grid import load_sweep

    with SweepProgress("checking the points") as checking:
        plan = load_sweep(sweep_file, checking.done)
    print_notes(plan)
    from msg_analysis.common.files import write_whole
    from msg_analysis.common.resources import pyarrow_problem
    from msg_analysis.common.text import finite
    from msg_analysis.report.list_pages import render_sweep
    from msg_analysis.report.sweep_plots import write_figure
    from msg_analysis.report.tables import describe_sweep, print_sweep, summary
    from msg_analysis.sweeps.points import options
    from msg_analysis.sweeps.results import ResultStore, evaluate_sweep, picture, rows_of, write_tables

    directory = out or Path("sweeps") / plan.name
    network = options(directory, keep_bags, workers or 1) if plan.kind == "network" else None
    with ResultStore.open(directory) as store:
        jobs, how = [point.job for point in plan.points], how | {"workers": workers, "scheduler": scheduler}
        done = _conduct(context, plan.name, jobs, store, network=network, **how)
        judgement = evaluate_sweep(done.outcomes, plan.spec.level)
        rows = rows_of(plan, done.outcomes, judgement)
        document = finite(describe_sweep(plan, done, judgement, rows))
        try:
            files = write_tables(rows, document, directory)
            if problem := pyarrow_problem():
                print_note(f"without results.parquet: pyarrow cannot be loaded ({problem})")
            plain_matplotlib()
            shown = picture(plan, rows, column)
            files += write_figure(shown, f"{plan.name}: {plan.kind}", directory)
            page = render_sweep(plan, rows, column, summary(document), judgement.verdict)
            files.append(write_whole(directory / "sweep.html", page.encode()))
        except OSError as error:
            raise InputError(f"{error.filename or directory}: cannot be written: {error.strerror}") from error
    if as_json:
        print_json(document | {"files": [str(file) for file in files]})
    else:
        print_sweep(plan, document, shown, result_console())
        for file in files:
            click.echo(file)
    context.exit(judgement.exit_code)


class _EndedBySignal(KeyboardInterrupt):
    """A signal, the argument, that ends the program as Ctrl-C does, with another exit code."""


def _end(number: int, _: object) -> None:
    from msg_analysis.sweeps.workers import ENDING

    for each in ENDING:
        signal.signal(each, signal.SIG_IGN)
    raise _EndedBySignal(number)


def _conduct(context: click.Context, title: str, jobs: Sequence[Job], store: ResultStore, **how: Any) -> JobResults:
    """Do all jobs, with progress on stderr; if interrupted, say what is kept and exit."""
    from msg_analysis.cli.console import SweepProgress
    from msg_analysis.sweeps.workers import ENDING, WorkersLostError, run_jobs

    if store.damaged:
        print_note(f"{store.directory}: {store.damaged} lines cannot be read: their points are computed again")
    for number in ENDING:
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP
            signal.signal(number, _end)
    try:
        with SweepProgress(title) as progress:
            return run_jobs(jobs, store, watch=progress.done, **how)
    except (KeyboardInterrupt, WorkersLostError) as error:
        there = sum(job.id in store.outcomes for job in jobs)
        kept = f"{there} of {len(jobs)} points are kept in {store.directory}: the same command continues"
        if isinstance(error, KeyboardInterrupt):
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the exit
            click.echo(f"\ninterrupted: {kept}", err=True)
            if isinstance(error, _EndedBySignal):
                context.exit(killed_by(error.args[0]))
            raise
        complain(f"{error}: {kept}")
        context.exit(ExitCode.INCOMPLETE)


def emulate(
    context: click.Context,
    numbers: Sequence[int],
    out: Path,
    formats: Sequence[str],
    other_software: OtherSoftware,
    *,
    as_json: bool,
) -> int:
    """``msg-analysis figures --emulate``: run the networks, write the figures; returns the exit code."""
    from msg_analysis.paper.figures import disagreeing, measured, runs_of, summary, write_figures
    from msg_analysis.sweeps.points import FAILED, options
    from msg_analysis.sweeps.results import ResultStore

    plain_matplotlib()
    runs = [run for number in numbers for run in runs_of(number)]
    directory = out / "emulation"
    network = options(directory, False, 1)
    with ResultStore.open(directory) as store:
        jobs = [run.job() for run in runs]
        done = _conduct(context, "networks", jobs, store, network=network, other_software=other_software, retry=True)
    points = measured(runs, done.outcomes)
    failed = [outcome for outcome in done.outcomes if outcome.status == FAILED]
    for outcome in failed:
        complain(f"no result: {outcome.reason}")
    if not points:
        return ExitCode.INCOMPLETE
    files = write_figures(numbers, out, formats, points)
    if as_json:
        rows = [asdict(point) for point in points]
        for place, key in [(row, "agent") for row in rows] + [(row["run"], "leader") for row in rows]:
            place[key] = None if place[key] is None else place[key] + 1  # from 1; None: the system
        print_json({"files": [str(file) for file in files], "points": rows, "agree": not disagreeing(points)})
    else:
        for path in files:
            click.echo(path)
        print_text(summary(points, len(runs) - len(failed)))
    return ExitCode.DISAGREES if disagreeing(points) else ExitCode.INCOMPLETE if failed else ExitCode.FINE
