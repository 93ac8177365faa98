# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands on bags and runs: compare, tabulate, runs, diff, export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from msg_analysis.cli.console import examples, print_json, print_note, print_result, print_text, result_console
from msg_analysis.cli.logs import compare_mapped
from msg_analysis.cli.options import (
    EXPERIMENT,
    FILE,
    LOG,
    PATH,
    RESULT,
    SOURCE,
    YAML,
    choice_option,
    is_bag,
    json_option,
    level_option,
    load_experiment,
    max_missed_option,
    seed_option,
    verbose_option,
)
from msg_analysis.common.resources import watched

if TYPE_CHECKING:
    from msg_analysis.runs import SortKey


@click.command(
    epilog=examples(
        "msg-agents runs",
        "msg-agents runs --name 'line_*' --verdict disagrees --since 7d",
        "msg-agents runs --last 20 --sort error --json | jq '.runs[].folder'",
        "msg-agents runs --open",
        "msg-analysis runs elsewhere --page overview.html",
    )
)
@click.argument("folder", type=PATH, default=Path("runs"))
@click.option("--name", metavar="NAME", help="Only runs of this experiment; a pattern such as 'line_*' may be given.")
@click.option(
    "--verdict",
    "verdicts",
    type=click.Choice(["agrees", "disagrees", "late", "incomplete", "unpredicted", "none"]),
    multiple=True,
    help="Only runs with this verdict; none: without one. Repeatable.",
)
@click.option("--since", metavar="WHEN", help="Only runs from then on: 2026-11-25, 2026-11-25T14:30 (UTC), or 7d.")
@click.option("--until", metavar="WHEN", help="Only runs up to then; a date is included.")
@seed_option
@click.option("--last", type=click.IntRange(1), metavar="N", help="Only the newest N of these.")
@choice_option("--sort", ["date", "name", "seed", "verdict", "error"], "Order of the list.", default="date")
@click.option("--page", type=FILE, metavar="FILE", help="Write these runs as a page for browsers, and print its name.")
@click.option(
    "--open", "shown", is_flag=True, help="Open the page in a browser; without --page it is FOLDER/index.html."
)
@json_option
def runs(
    folder: Path,
    *,
    since: str | None,
    until: str | None,
    sort: SortKey,
    page: Path | None,
    shown: bool,
    as_json: bool,
    **filters: Any,
) -> None:
    """List the runs in FOLDER, or write a page of them.

    Uses saved results (or the run record); does not read states. The page compares the runs of an experiment.
    """
    from datetime import UTC, datetime

    from msg_analysis.common.files import require_place
    from msg_analysis.runs import RunFilter, list_runs, moment

    now = datetime.now(UTC)
    wanted = RunFilter(
        since=moment(since, "--since", now) if since is not None else None,
        until=moment(until, "--until", now, end=True) if until is not None else None,
        **filters,
    )
    page = page or (folder / "index.html" if shown else None)
    require_place(page)
    found = list_runs(folder)
    chosen = wanted.choose(found, sort)
    if page is not None:
        from msg_analysis.report.list_pages import write_runs_page

        write_runs_page(chosen, folder, page)
    if as_json:
        listed = [run.to_json() for run in chosen]
        print_json({"folder": str(folder), "total": len(found), "page": str(page) if page else None, "runs": listed})
    elif page is not None:
        click.echo(page)
    else:
        from msg_analysis.report.tables import print_runs

        print_runs(chosen, folder, len(found), result_console())
    if shown and page is not None:
        _open(page)


def _open(page: Path) -> None:
    """Show a page in a browser; where there is none, or no display, say where it is."""
    import os
    import sys
    import webbrowser

    address = page.absolute().as_uri()
    screen = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if not screen or not webbrowser.open(address):
        print_note(f"no {'browser' if screen else 'display'} here: open {address} in a browser")


@click.command(
    epilog=examples(
        "msg-analysis diff runs/ring_20250101_120000 runs/ring_20250101_130000",
        "msg-analysis diff line_ring fast_switching",
        "msg-analysis diff line_ring fast_switching --json | jq .keys",
    )
)
@click.argument("a", type=SOURCE)
@click.argument("b", type=SOURCE)
@json_option
def diff(a: Path, b: Path, *, as_json: bool) -> None:
    """Compare two bags, or two experiment files.

    Of bags: experiment, versions, states to the last bit, graphs, verdicts and measured errors. Of experiments: keys,
    predictions, decay rates and leaders. The exit code is 0 also if they differ.
    """
    from msg_analysis.errors import InputError

    bags = [is_bag(path) for path in (a, b)]
    if bags[0] != bags[1]:
        bag, experiment = (a, b) if bags[0] else (b, a)
        raise InputError(f"{bag} is a bag, {experiment} an experiment: expected two bags or two experiment files")
    if bags[0]:
        from msg_analysis.cli.console import WorkProgress
        from msg_analysis.report.differences import bag_difference
        from msg_analysis.report.differences import print_bag_difference as show

        with WorkProgress() as work, watched(work):
            document = bag_difference(a, b)
    else:
        from msg_analysis.cli.console import SolveProgress
        from msg_analysis.report.differences import experiment_difference
        from msg_analysis.report.differences import print_experiment_difference as show

        one, other = (load_experiment(path) for path in (a, b))
        with SolveProgress("leaders") as search:
            document = experiment_difference(one, other, search)
    print_result(document, show, as_json=as_json)


@click.command(
    epilog=examples(
        "msg-analysis compare line_ring_twin",
        "msg-analysis compare line_ring_twin --report report.html",
        "msg-analysis compare runs/line_ring_* --level 0.001 --json > pooled.json",
        "msg-analysis compare robots --law law.yaml --map map.yaml",
    )
)
@click.argument("bags", metavar="BAG...", nargs=-1, required=True, type=LOG)
@click.option(
    "--law", type=EXPERIMENT, metavar="EXPERIMENT", help="Of a bag or table of others: what it should follow."
)
@click.option("--map", "mapped", type=YAML, metavar="MAP", help="With --law: where in it the states and graphs are.")
@level_option("Probability of a false 'disagrees', over all tests.")
@max_missed_option
@click.option("--save/--no-save", default=True, help="Keep the result with a single bag (result.json), for `runs`.")
@click.option("--report", type=FILE, metavar="FILE", help="Also write an HTML report.")
@verbose_option
@json_option
@click.pass_context
def compare(
    context: click.Context,
    bags: tuple[Path, ...],
    *,
    law: Path | None,
    mapped: Path | None,
    level: float,
    max_missed: float,
    save: bool,
    report: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Compare the run in BAG with its prediction.

    Several bags, runs of one experiment with different seeds, get one joint verdict. With --law and --map, BAG may be
    a bag of other robots, or a CSV, Parquet or NPZ file; `map` makes a first MAP.

    Exit code 0: agrees, 1: disagrees, 3: data incomplete, no verdict, 4: late (real time).
    """
    from msg_analysis.cli.console import WorkProgress
    from msg_analysis.common.files import require_place
    from msg_analysis.inference.pool import compare as compare_runs
    from msg_analysis.runs import keep_result

    require_place(report)
    if law or mapped or any(bag.suffix.lower() in (".csv", ".parquet", ".npz") for bag in bags):
        context.exit(compare_mapped(bags, law, mapped, level, report, verbose=verbose, as_json=as_json))
    with WorkProgress() as progress, watched(progress):
        comparison = compare_runs(*bags, level=level, max_missed=max_missed)
        if report:
            from msg_analysis.report.page import write_report

            write_report(comparison, report)
    document = comparison.to_json()
    if save and len(bags) == 1 and bags[0].is_dir():
        try:
            keep_result(bags[0], document)
        except OSError as error:
            print_note(f"{bags[0]}: the result could not be kept ({error.strerror}): --no-save leaves it out")
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.comparison_text import print_comparison

        print_comparison(document, result_console(), verbose=verbose)
        if report:
            print_text(f"report: {report}")
    context.exit(comparison.exit_code)


@click.command(
    epilog=examples(
        "msg-analysis compare leader_1 --json > leader_1.json",
        "msg-analysis tabulate leader_*.json",
        "msg-analysis tabulate runs/*/result.json --format csv > runs.csv",
    )
)
@click.argument("results", metavar="RESULT...", nargs=-1, required=True, type=RESULT)
@click.option(
    "--format",
    "form",
    type=click.Choice(["table", "markdown", "csv", "json"]),
    default="table",
    help="Form of the output; the table also shows which system errors differ significantly.",
)
@level_option("Probability of any false difference of two system errors.")
@json_option
def tabulate(results: tuple[Path, ...], form: str, level: float, as_json: bool) -> None:
    """Show saved results side by side.

    A RESULT is a file written by `compare --json` or `msg-agents run`, or the directory of a run. The runs are
    assumed to be independent (different seeds).
    """
    from msg_analysis.errors import InputError
    from msg_analysis.report import saved_results as saved
    from msg_analysis.runs import read_result

    rows, unreadable = [], []
    for path in results:
        try:
            rows.append(read_result(path))
        except InputError as error:
            unreadable.append(error)
    if not rows:
        raise unreadable[0]
    for problem in unreadable:
        print_note(f"not readable: {problem}")
    if as_json or form == "json":
        print_json(saved.to_json(rows, level))
    elif form == "csv":
        print_text(saved.to_csv(rows).removesuffix("\n"))
    elif form == "markdown":
        print_text(saved.to_markdown(rows).removesuffix("\n"))
    else:
        saved.print_results(rows, level, result_console())
