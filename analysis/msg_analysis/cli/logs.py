# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Logs of other robots: the command ``map``, and ``compare``, ``spectrum`` and ``export`` with a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from msg_analysis.cli.console import (
    WorkProgress,
    examples,
    print_json,
    print_note,
    print_result,
    print_text,
    result_console,
)
from msg_analysis.cli.options import LOG, YAML, json_option, load_experiment
from msg_analysis.common.resources import watched
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis.model.log import Log
    from msg_analysis.report.export import Form


@click.command(
    "map",
    epilog=examples(
        "msg-analysis map robots > map.yaml",
        "msg-analysis map robots --map map.yaml --check",
        "msg-analysis map robots --check --json | jq .agents",
    ),
)
@click.argument("log", metavar="BAG|DATA", type=LOG)
@click.option("--map", "mapped", type=YAML, metavar="MAP", help="With --check: a map, in place of the first one.")
@click.option("--check", is_flag=True, help="Print what is in it: agents, rates, gaps, jumps of the clock, duplicates.")
@json_option
def map_(log: Path, *, mapped: Path | None, check: bool, as_json: bool) -> None:
    """Map a bag of other robots, or check a map.

    A map says where the states and the graphs are, for `compare --law --map`. It is guessed from the types and names
    of the topics: read it, and correct it.
    """
    from msg_analysis.bags.first_map import check_log, first_map
    from msg_analysis.bags.log_map import load_map
    from msg_analysis.bags.mapped_log import is_table

    if not check and (mapped or as_json):
        raise InputError(f"{'--map' if mapped else '--json'}: expected with --check: add it")
    if not check and is_table(log):
        raise InputError(f"{log}: is a table: expected a bag: name its columns in a map as `field`")
    with WorkProgress() as progress, watched(progress):
        if not check:
            text = first_map(log)
        else:
            document = check_log(log, load_map(mapped) if mapped else None)
    if not check:
        print_text(text.removesuffix("\n"))
        return
    from msg_analysis.report.log_text import print_log_check

    print_result(document, print_log_check, as_json=as_json)


def export_mapped(log: Path, mapped: Path, directory: Path, forms: Sequence[Form], *, as_json: bool) -> None:
    """Write a log of others as files, and print their names."""
    from msg_analysis.bags.log_map import load_map
    from msg_analysis.report.log_export import MappedLog, export_log

    with WorkProgress() as progress, watched(progress):
        found = MappedLog.read(log, load_map(mapped))
        files = [str(file) for file in export_log(found, directory, forms)]
    for note in found.notes:
        print_note(note)
    if as_json:
        print_json({"files": files, "missing": found.missing})
    else:
        print_text("\n".join(files))


def compare_mapped(
    logs: tuple[Path, ...],
    law: Path | None,
    mapped: Path | None,
    level: float,
    report: Path | None,
    *,
    verbose: bool,
    as_json: bool,
) -> int:
    """Compare a log of others, and print the result; the exit code."""
    from msg_analysis.report.log_text import print_log_comparison

    if len(logs) > 1:
        raise InputError(f"{logs[1]}: expected one bag or table with --law: compare them one after the other")
    log = mapped_log(logs[0], law, mapped)
    with WorkProgress() as progress, watched(progress):
        comparison = log.compare(level=level)
        if report:
            from msg_analysis.report.log_page import write_log_report

            write_log_report(comparison, report)
    document = comparison.to_json()
    if as_json:
        print_json(document)
    else:
        print_log_comparison(document, result_console(), verbose=verbose)
    return comparison.exit_code


def mapped_log(log: Path, law: Path | None, mapped: Path | None) -> Log:
    """Read a log of others."""
    from msg_analysis.bags.log_map import load_map
    from msg_analysis.bags.mapped_log import is_table, read_log, read_table
    from msg_analysis.model.log import Log

    if law is None:
        raise InputError("--law: missing: expected the experiment file that the log should follow")
    if mapped is None and not is_table(log):
        raise InputError(f"--map: missing: expected where the states in {log} are: `msg-analysis map {log}` makes one")
    experiment = load_experiment(law)
    with WorkProgress() as progress, watched(progress):
        if mapped:
            return read_log(log, load_map(mapped), experiment, mapped.parent)
        columns = read_table(log)
        try:
            return Log.from_columns(columns, law=experiment)
        except InputError as error:
            raise InputError(f"{log}: {error}") from error
