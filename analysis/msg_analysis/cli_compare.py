"""Commands of ``msg-analysis`` about runs: ``compare`` bags with the prediction, ``tabulate`` what came out."""

from __future__ import annotations

from pathlib import Path

import click

from msg_analysis.console import examples, print_json, result_console
from msg_analysis.errors import InputError


def _checked_level(_context: click.Context, _option: click.Parameter, value: float) -> float:
    if not 0.0 < value <= 0.5:
        raise click.BadParameter(f"{value:g}: expected a chance above 0, 0.5 at most")
    return value


_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")


@click.command(
    epilog=examples(
        "msg-analysis compare line_ring_twin",
        "msg-analysis compare line_ring_twin --report report.html",
        "msg-analysis compare runs/line_ring_* --level 0.001 --json > pooled.json",
    )
)
@click.argument("bags", metavar="BAG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@_json
@click.option(
    "--level",
    type=float,
    callback=_checked_level,
    default=0.01,
    help="Chance of a false 'disagrees', all tests together; 0.01 by default.",
)
@click.option("--report", type=click.Path(dir_okay=False, path_type=Path), help="Write a report (HTML) as well.")
@click.pass_context
def compare(context: click.Context, bags: tuple[Path, ...], as_json: bool, level: float, report: Path | None) -> None:
    """Compare what the run in BAG did with what theory predicts.

    Several bags, runs of one experiment with different seeds, get one verdict together.

    Exit code 0: agrees, 1: disagrees, 3: data incomplete, no verdict.
    """
    from msg_analysis.bags.reader import read_bag
    from msg_analysis.inference.compare import compare as compare_trajectory
    from msg_analysis.inference.pool import compare_pooled

    if report and not report.parent.is_dir():
        raise InputError(f"{report}: no such directory {report.parent}: create it")
    absent = [str(bag) for bag in bags if not bag.exists()]
    if absent and len(bags) > 1:
        raise InputError(f"{', '.join(absent)}: not found: expected bags, {len(bags)} were given")
    if len(bags) == 1:
        trajectory = read_bag(bags[0])
        comparison = compare_trajectory(trajectory, level=level)
    else:
        comparison = compare_pooled(((str(bag), read_bag(bag)) for bag in bags), level=level)
        trajectory = comparison.trajectory
    if report:
        from msg_analysis.report.html import write_report

        write_report(comparison, trajectory, report)
    if as_json:
        print_json(comparison.to_json())
    else:
        from msg_analysis.report.text import print_comparison

        print_comparison(comparison.to_json(), result_console())
    context.exit(comparison.exit_code)


@click.command(
    epilog=examples(
        "msg-analysis compare leader_1 --json > leader_1.json",
        "msg-analysis tabulate leader_*.json",
        "msg-analysis tabulate runs/*/result.json --format csv > runs.csv",
    )
)
@click.argument("results", metavar="RESULT...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--format",
    "form",
    type=click.Choice(["table", "markdown", "csv", "json"]),
    default="table",
    help="table (default) says in words as well which system errors can be told apart.",
)
@click.option(
    "--level",
    type=float,
    callback=_checked_level,
    default=0.01,
    help="Chance of telling any two system errors apart wrongly; 0.01 by default.",
)
def tabulate(results: tuple[Path, ...], form: str, level: float) -> None:
    """Put saved results side by side: files that ``compare --json`` or ``msg-agents run`` wrote.

    A RESULT may be the directory of a run, too. Independent runs, that is other seeds, are taken for granted.
    """
    from msg_analysis.report import results as saved

    rows = [saved.read_result(path) for path in results]
    if form == "json":
        print_json(saved.to_json(rows, level))
    elif form == "csv":
        click.echo(saved.to_csv(rows), nl=False)
    elif form == "markdown":
        click.echo(saved.to_markdown(rows), nl=False)
    else:
        saved.print_results(rows, level, result_console())
