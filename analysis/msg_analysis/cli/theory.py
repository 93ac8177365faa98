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

"""Commands of ``msg-analysis`` for theory beyond the steady state: ``transient`` and ``facts``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from msg_analysis.cli.console import examples, print_json, result_console
from msg_analysis.cli.options import FILE, experiment_argument, json_option
from msg_analysis.common.files import require_place
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis.types import FloatArray


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
@click.option(
    "--law",
    type=click.Choice(["emulated", "continuous"]),
    default="emulated",
    help="The steps of the run, or the paper's continuous time.",
)
@click.option("--unreduced", is_flag=True, help="Consensus: errors of the states, not of the disagreement.")
@click.option(
    "--fraction", type=float, metavar="F", default=0.05, help="Fraction of the steady error, for the settling time."
)
@click.option("--moments", is_flag=True, help="With --json: also means and second moments of every graph.")
@click.option("--csv", "table", type=FILE, metavar="FILE", help="Also write a CSV table.")
@json_option
def transient(
    experiment: Path,
    times: str,
    law: str,
    unreduced: bool,
    fraction: float,
    moments: bool,
    table: Path | None,
    as_json: bool,
) -> None:
    """Predict the errors of EXPERIMENT over time, from its own start, exactly."""
    from msg_analysis.model.experiment.experiment import ValidExperiment
    from msg_analysis.report.documents.transient_and_facts import describe_transient, write_transient_csv

    require_place(table)
    loaded = ValidExperiment.load(experiment)
    loaded.require_available("predict")
    document = describe_transient(
        loaded,
        _parse_times(times),
        law=law,  # type: ignore[arg-type]  # click has checked it
        unreduced=unreduced,
        moments=moments,
        fraction=fraction,
    )
    if table:
        write_transient_csv(document, table)
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.terminal.theory_text import print_transient

        print_transient(document, result_console())


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
    """Check the paper's lemmas on EXPERIMENT; bounds, indices of its graphs, two graphs in closed form."""
    from msg_analysis.model.experiment.experiment import ValidExperiment
    from msg_analysis.report.documents.transient_and_facts import describe_facts

    loaded = ValidExperiment.load(experiment)
    loaded.require_available("predict")
    document = describe_facts(loaded)
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.terminal.theory_text import print_facts

        print_facts(document, result_console())
