# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Commands of ``msg-analysis`` for theory beyond the steady state: ``transient``, ``facts``, ``plan``, ``spectrum``."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from msg_analysis.cli.console import examples, plain_matplotlib, print_result
from msg_analysis.cli.logs import mapped_log
from msg_analysis.cli.options import (
    EXPERIMENT,
    FILE,
    SOURCE,
    YAML,
    choice_option,
    experiment_argument,
    is_bag,
    json_option,
    level_option,
    load_experiment,
    set_option,
)
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis.common.arrays import FloatArray


@click.command(
    epilog=examples(
        "msg-analysis transient line_ring --times 0:10:0.5",
        "msg-analysis transient line_ring --times 0,1,10 --law continuous",
    )
)
@experiment_argument
@click.option(
    "--times", metavar="TIMES", required=True, help="START:STOP:STEP or t1,t2,... in units of simulated time."
)
@choice_option(
    "--law", ["emulated", "continuous"], "Steps of the run, or the continuous time of the paper.", default="emulated"
)
@click.option("--unreduced", is_flag=True, help="Consensus: errors of the states, not of the disagreement.")
@click.option(
    "--fraction", type=float, metavar="F", default=0.05, help="Fraction of the steady error, for the settling time."
)
@click.option("--moments", is_flag=True, help="With --json: also means and second moments of every graph.")
@click.option("--csv", "table", type=FILE, metavar="FILE", help="Also write a CSV table.")
@json_option
def transient(experiment: Path, times: str, *, table: Path | None, as_json: bool, **options: Any) -> None:
    """Predict the errors over time, from the start of a run."""
    from msg_analysis.common.files import require_place
    from msg_analysis.report.documents import describe_transient, write_transient_csv
    from msg_analysis.report.theory_text import print_transient

    require_place(table)
    loaded = load_experiment(experiment)
    loaded.require_available("predict")
    document = describe_transient(loaded, _parse_times(times), **options)
    if table:
        write_transient_csv(document, table)
    print_result(document, print_transient, as_json=as_json)


MOST_TIMES = 100_000


def _parse_times(text: str) -> FloatArray:
    """Times (T,) from ``START:STOP:STEP`` (STOP included if met) or ``t1,t2,...``; InputError for anything else."""
    import numpy as np

    wanted = "expected START:STOP:STEP or t1,t2,..., ascending numbers >= 0: for example 0:10:0.5"
    try:
        parts = [float(part) for part in text.replace(":", ",").split(",")]
    except ValueError:
        raise InputError(f"--times {text}: {wanted}") from None
    if not np.isfinite(parts).all():
        raise InputError(f"--times {text}: {wanted}")
    if ":" not in text:
        return np.array(parts)
    if len(parts) != 3 or text.count(":") != 2 or parts[2] <= 0.0 or parts[1] < parts[0]:
        raise InputError(f"--times {text}: {wanted}")
    start, stop, step = parts
    most = (stop - start) / step * (1.0 + 1e-12) + 1e-9
    if not most < MOST_TIMES:
        raise InputError(f"--times {text}: expected at most {MOST_TIMES} times: give a larger STEP")
    count = int(most) + 1
    return np.asarray(start + step * np.arange(count), dtype=float)


@click.command(epilog=examples("msg-analysis facts line_ring", "msg-analysis facts line_ring --json | jq .bounds"))
@experiment_argument
@json_option
def facts(experiment: Path, as_json: bool) -> None:
    """Check the lemmas of the paper; bounds, graph indices."""
    from msg_analysis.report.documents import describe_facts
    from msg_analysis.report.theory_text import print_facts

    loaded = load_experiment(experiment)
    loaded.require_available("steady")
    document = describe_facts(loaded)
    print_result(document, print_facts, as_json=as_json)


UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


@click.command(
    epilog=examples(
        "msg-analysis plan line_ring --precision 1%",
        "msg-analysis plan line_ring --budget 10min --speed 5000",
        "msg-analysis plan line_ring --set run.replicas=64",
        "msg-analysis plan line_ring --json | jq .faults",
    )
)
@experiment_argument
@click.option(
    "--precision",
    metavar="SHARE",
    default="1%",
    help="Half-width of the 95 % interval of the system error, relative to it: 1% or 0.01.",
)
@click.option("--budget", metavar="TIME", help="Time budget: 90s, 10min, 2h or 1d; finds the best replicas.")
@click.option(
    "--speed", type=float, metavar="STEPS", help="Steps per second of a run in lockstep, as msg-agents run prints them."
)
@level_option("Probability of a false 'disagrees', over all tests.")
@set_option
@json_option
def plan(
    experiment: Path,
    *,
    precision: str,
    budget: str | None,
    speed: float | None,
    level: float,
    changes: tuple[str, ...],
    as_json: bool,
) -> None:
    """Find how long to run EXPERIMENT; nothing is run.

    Length, replicas and time for a precision, and the power of the tests for faults.
    """
    from msg_analysis.report.theory_text import print_plan

    loaded = load_experiment(experiment, changes)
    document = loaded.plan(
        parse_share(precision), seconds=parse_duration("--budget", budget), rate=speed, level=level
    ).to_json()
    print_result(document, print_plan, as_json=as_json)


def parse_share(text: str) -> float:
    """A share of 1 from ``1%``, ``1 %`` or ``0.01``; InputError for anything else."""
    number, share = text.strip(), -1.0
    with suppress(ValueError):
        share = float(number.removesuffix("%")) / (100.0 if number.endswith("%") else 1.0)
    if not 0.0 < share < 1.0:
        raise InputError(f"--precision {text}: expected a share above 0, below 1: for example 1% or 0.01")
    return share


def parse_duration(key: str, text: str | None) -> float | None:
    """Seconds from a number and one of ``UNITS``, s if there is none; InputError for anything else."""
    if text is None:
        return None
    number, seconds = text.strip(), -1.0
    unit = next((unit for unit in ("min", "s", "h", "d") if number.endswith(unit)), "")
    with suppress(ValueError):
        seconds = float(number.removesuffix(unit)) * UNITS[unit or "s"]
    if not 0.0 < seconds < float("inf"):
        raise InputError(f"{key} {text}: expected a number above 0 with s, min, h or d: for example 10min")
    return seconds


@click.command(
    epilog=examples(
        "msg-analysis spectrum line_ring",
        "msg-analysis spectrum runs/line_ring_1 --figure spectrum.png",
        "msg-analysis spectrum line_ring --json | jq .system_density",
        "msg-analysis spectrum robots --law law.yaml --map map.yaml",
    )
)
@click.argument("source", metavar="EXPERIMENT|BAG", type=SOURCE)
@click.option(
    "--law", type=EXPERIMENT, metavar="EXPERIMENT", help="Of a bag or table of others: what it should follow."
)
@click.option("--map", "mapped", type=YAML, metavar="MAP", help="With --law: where in it the states and graphs are.")
@click.option("--figure", type=FILE, metavar="FILE", help="Also draw it: a file that ends with .png, .svg or .pdf.")
@level_option("Of the test of a bag: probability of a false 'disagrees'.")
@set_option
@json_option
@click.pass_context
def spectrum(
    context: click.Context,
    source: Path,
    *,
    law: Path | None,
    mapped: Path | None,
    figure: Path | None,
    level: float,
    changes: tuple[str, ...],
    as_json: bool,
) -> None:
    """Predict autocovariance and spectrum, or test a bag.

    Of a BAG they are also measured, and tested against the prediction. With --law and --map, BAG may be a bag of other
    robots, or a CSV, Parquet or NPZ file.

    Exit code 0: predicted, or agrees, 1: disagrees, 3: data incomplete.
    """
    from msg_analysis.common.files import require_place
    from msg_analysis.errors import ExitCode
    from msg_analysis.report.documents import measure_log_spectrum, measure_spectrum, predicted_spectrum
    from msg_analysis.report.theory_text import print_spectrum

    if changes and (law or is_bag(source)):
        raise InputError(f"--set: not with the bag {source}, whose experiment is recorded: give an experiment file")
    require_place(figure)
    if figure:
        from msg_analysis.report.figures import require_format, spectrum_figure, write_spectrum

        require_format(figure)
        plain_matplotlib()
    if law or mapped:
        found = measure_log_spectrum(mapped_log(source, law, mapped), level)
    elif is_bag(source):
        found = measure_spectrum(source, level)
    else:
        found = predicted_spectrum(load_experiment(source, changes))
    if figure:
        write_spectrum(spectrum_figure(found.predicted, found.log, found.density), figure)
    print_result(found.to_json(), print_spectrum, as_json=as_json)
    if not found.complete:
        context.exit(ExitCode.INCOMPLETE)
    context.exit(ExitCode.DISAGREES if found.disagrees else ExitCode.FINE)
