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

"""The command ``doctor``."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from msg_agents.processes.fork_server import early_server, prepared
from msg_analysis.cli.console import complain, examples, print_json, result_console
from msg_analysis.cli.options import PATH, json_option
from msg_analysis.common.exit_codes import ExitCode

if TYPE_CHECKING:
    from rich.console import Console

    from msg_agents.doctor.check import Check
    from msg_agents.doctor.networks.outcome import Outcome

STYLES = {"ok": "green", "warning": "bold yellow", "error": "bold red"}
NETWORKS = 10


@click.command(
    epilog=examples(
        "msg-agents doctor",
        "msg-agents doctor --network --networks 50 --first-seed 7",
    )
)
@click.option(
    "--network", is_flag=True, help="Instead run random networks with random faults, and compare them with their twins."
)
@click.option(
    "--networks", type=click.IntRange(1), metavar="N", show_default=str(NETWORKS), help="How many random networks."
)
@click.option(
    "--first-seed",
    type=click.IntRange(0),
    metavar="N",
    show_default="0",
    help="Seed of the first random network; the next one has the next seed.",
)
@click.option(
    "--out", type=PATH, metavar="DIR", show_default="runs", help="Directory in which networks that fail are kept."
)
@json_option
def doctor(
    *,
    network: bool,
    networks: int | None,
    first_seed: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Say what this machine and shell would do to a run, and what to do about it.

    The last check runs two processes for a second. Exit code 2: a run cannot work; warnings do not change it.

    With --network: whether random networks in lockstep, whose processes are killed and stopped, are equal to their
    twins to the last bit. Exit code 1: one differs; 3: none differs, but one has failed.
    """
    of_networks = {"--networks": networks, "--first-seed": first_seed, "--out": out}
    if not network and (alone := [name for name, value in of_networks.items() if value is not None]):
        raise click.UsageError(f"{alone[0]} {of_networks[alone[0]]}: it is for random networks: add --network")
    click.get_current_context().with_resource(prepared() if network else early_server())
    if network:
        _run_networks(NETWORKS if networks is None else networks, first_seed or 0, out or Path("runs"), as_json)
    else:
        _examine(as_json)


def _examine(as_json: bool) -> None:
    from msg_agents.doctor.examination import examine

    console, found = result_console(), []
    for check in examine():
        found.append(check)
        if not as_json:
            _print_check(console, check)
    counts = Counter(check.status for check in found)
    can_run = not counts["error"]
    if as_json:
        counted = {"errors": counts["error"], "warnings": counts["warning"]}
        print_json({"can_run": can_run, **counted, "checks": [check.to_json() for check in found]})
    else:
        console.print(_summary(counts["error"], counts["warning"]), soft_wrap=True)
    if not can_run:
        sys.exit(ExitCode.BAD_INPUT)


def _print_check(console: Console, check: Check) -> None:
    """One line; terminals get the text folded in a column of its own."""
    from rich.table import Table
    from rich.text import Text

    status, name = Text(f"{check.status:<8}", STYLES[check.status]), Text(f"{check.name.replace('_', ' '):<20}", "bold")
    if console.is_terminal:
        row = Table.grid(padding=(0, 1))
        row.add_row(status, name, Text(check.text, overflow="fold"))
        row.columns[0].no_wrap = row.columns[1].no_wrap = True
        console.print(row)
    else:
        console.print(Text(" ").join([status, name, Text(check.text)]))


def _summary(errors: int, warnings: int) -> str:
    noted = f" ({warnings} warning{'s' * (warnings > 1)})" if warnings else ""
    return f"A run cannot work here{noted}." if errors else f"A run can work here{noted}."


def _run_networks(count: int, first_seed: int, out: Path, as_json: bool) -> None:
    from msg_agents.doctor.networks.outcome import exit_code, to_json
    from msg_agents.doctor.networks.trial import require_directory, run_trial
    from msg_agents.terminal.interruption import Interruption
    from msg_analysis.cli.progress import NetworkProgress

    require_directory(out)
    outcomes: list[Outcome] = []
    with NetworkProgress("networks") as progress, Interruption() as interruption:
        for number in range(count):
            outcomes.append(run_trial(first_seed + number, out))
            interruption.check()
            progress.done(number + 1, count, sum(not outcome.good for outcome in outcomes))
            if not outcomes[-1].good:
                complain(_failure(outcomes[-1]), "failed:")
    if as_json:
        print_json(to_json(outcomes))
    else:
        _print_networks(outcomes)
    sys.exit(exit_code(outcomes))


def _failure(outcome: Outcome) -> str:
    kept = f"kept in {outcome.folder}, again: msg-agents doctor --network --networks 1 --first-seed {outcome.seed}"
    return f"network {outcome.seed}: {outcome.verdict.text} ({kept})"


def _print_networks(outcomes: Sequence[Outcome]) -> None:
    """A row for each network, or for those only that failed if there are many."""
    from msg_agents.doctor.networks.outcome import summary
    from msg_analysis.report.terminal.tables import ROWS, number_table, print_table

    console = result_console()
    shown = outcomes if len(outcomes) <= ROWS else [outcome for outcome in outcomes if not outcome.good]
    if shown:
        heads = ("seed", "agents", "processes", "graphs", "steps", "kills", "stops", "stalls", "states", "seconds")
        table = number_table(console, "Random networks", "result", *heads)
        for each in shown:
            size = (each.seed, each.agents, each.processes, each.graphs, each.steps)
            found = (each.kills, each.stops, len(each.stalls), each.verdict.compared)
            table.add_row(each.verdict.status, *map(str, size + found), f"{each.wall_time:.1f}")
        print_table(console, table)
    console.print(summary(outcomes), soft_wrap=True)
