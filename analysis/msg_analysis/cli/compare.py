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

"""Commands of ``msg-analysis`` about runs: ``compare`` (bags with the prediction) and ``tabulate`` (saved results)."""

from __future__ import annotations

from pathlib import Path

import click

from msg_analysis.cli.console import examples, print_json, print_text, result_console
from msg_analysis.cli.options import BAG, FILE, RESULT, json_option, level_option
from msg_analysis.common.files import require_place
from msg_analysis.common.long_work import watched


@click.command(
    epilog=examples(
        "msg-analysis compare line_ring_twin",
        "msg-analysis compare line_ring_twin --report report.html",
        "msg-analysis compare runs/line_ring_* --level 0.001 --json > pooled.json",
    )
)
@click.argument("bags", metavar="BAG...", nargs=-1, required=True, type=BAG)
@level_option("Probability of a false 'disagrees', over all tests.")
@click.option("--report", type=FILE, metavar="FILE", help="Also write an HTML report.")
@json_option
@click.pass_context
def compare(context: click.Context, bags: tuple[Path, ...], as_json: bool, level: float, report: Path | None) -> None:
    """Compare the run in BAG with its prediction.

    Several bags, runs of one experiment with different seeds, get one joint verdict.

    Exit code 0: agrees, 1: disagrees, 3: data incomplete, no verdict.
    """
    from msg_analysis import api
    from msg_analysis.cli.progress import WorkProgress

    require_place(report)
    with WorkProgress() as progress, watched(progress):
        comparison = api.compare(*bags, level=level)
        if report:
            api.write_report(comparison, report)
    if as_json:
        print_json(comparison.to_json())
    else:
        from msg_analysis.report.terminal.comparison_text import print_comparison

        print_comparison(comparison.to_json(), result_console())
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
    help="The table also says which system errors differ significantly.",
)
@level_option("Probability of any false difference of two system errors.")
@json_option
def tabulate(results: tuple[Path, ...], form: str, level: float, as_json: bool) -> None:
    """Show saved results side by side: files written by `compare --json` or `msg-agents run`.

    A RESULT may also be the directory of a run. The runs are assumed to be independent (different seeds).
    """
    from msg_analysis.report.terminal import saved_results as saved
    from msg_analysis.runs.saved_result import read_result

    rows = [read_result(path) for path in results]
    if as_json or form == "json":
        print_json(saved.to_json(rows, level))
    elif form == "csv":
        print_text(saved.to_csv(rows).removesuffix("\n"))
    elif form == "markdown":
        print_text(saved.to_markdown(rows).removesuffix("\n"))
    else:
        saved.print_results(rows, level, result_console())
