# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The command line ``msg-analysis``: each command parses, calls one function and prints.

Results go to stdout, everything else to stderr. Exit codes: 0 fine or agrees, 1 disagrees, 2 bad usage or
input, 3 data incomplete, 4 late, 70 a fault of the program. Slow imports are made inside the commands that need them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from msg_analysis.cli import logs, runs, sweep, theory
from msg_analysis.cli.console import (
    CommandGroup,
    complain,
    examples,
    plain_matplotlib,
    print_json,
    print_result,
    print_text,
)
from msg_analysis.cli.options import (
    BAG,
    LOG,
    PATH,
    SOURCE,
    YAML,
    choice_option,
    duration_option,
    experiment_argument,
    is_bag,
    json_option,
    load_experiment,
    out_option,
    parse_agents,
    seed_option,
    set_option,
    storage_options,
)
from msg_analysis.common.resources import __version__
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis.bags.stored_file import Storage
    from msg_analysis.sweeps.workers import OtherSoftware


FORMATS = ("png", "svg", "pdf")  # of figures


@click.group(cls=CommandGroup)
@click.version_option(__version__, prog_name="msg-analysis")
def main() -> None:
    """Theory, simulation and statistics of Markov-switching networks of agents."""


@click.command(
    epilog=examples(
        "msg-analysis predict line_ring",
        "msg-analysis predict line_ring --set noise.process=2 --json | jq .emulated",
        "msg-analysis predict line_ring --precision 0.5%",
    )
)
@experiment_argument
@set_option
@click.option(
    "--from", "start", type=float, metavar="TIME", default=0.0, help="Of a schedule: the mean of later times only."
)
@click.option(
    "--outages",
    type=click.IntRange(min=0),
    metavar="K",
    show_default="5, where that is fast",
    help="Of a schedule: what the K longest outages cost.",
)
@click.option("--precision", metavar="SHARE", help="Sample; half-width of the 95 % interval, relative: 1% or 0.01.")
@click.option("--within", metavar="TIME", help="Sample for at most this time: 90s, 10min.")
@click.option("--agents", metavar="LIST", help="Sample the errors of these agents, too: 1,17.")
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Sample with so many processes.")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Sample on the workers of this Dask scheduler.")
@seed_option
@json_option
def predict(
    experiment: Path, *, changes: tuple[str, ...], start: float, outages: int | None, as_json: bool, **sampling: Any
) -> None:
    """Predict the steady errors, exactly or by sampling.

    They are sampled, with an interval, where the exact way is too large, or with --precision (1%), --within (60s),
    --agents (all of up to 20), --workers, --scheduler or --seed.
    """
    from msg_analysis.experiment.limits import prediction_method
    from msg_analysis.report.theory_text import print_prediction
    from msg_analysis.theory.sampling import sampled_prediction

    loaded = load_experiment(experiment, changes)
    given = {key: value for key, value in sampling.items() if value is not None}
    if not given and prediction_method(loaded)[0] != "sampled":
        document = loaded.predict(start=start).to_json(outages)
    else:
        if outages is not None:
            raise InputError(f"--outages {outages}: expected with an exact prediction of a schedule: leave it out")
        if start:
            raise InputError(f"--from {start:g}: expected with a schedule; a steady state has no time: leave it out")
        if "workers" in given and "scheduler" in given:
            raise InputError(sweep.BOTH)
        if "seed" in given:
            loaded = loaded.with_run(seed=given.pop("seed"))
        if "agents" in given:
            given["agents"] = parse_agents(given["agents"])
        if "precision" in given:
            given["precision"] = theory.parse_share(given["precision"])
        if "within" in given:
            given["within"] = theory.parse_duration("--within", given["within"])
        document = sampled_prediction(loaded, **given).to_json()
    print_result(document, print_prediction, as_json=as_json)


@click.command(
    epilog=examples("msg-analysis simulate line_ring", "msg-analysis simulate line_ring --seed 8 --out twin_8")
)
@experiment_argument
@out_option("BAG", "Bag to write; must not exist.", show_default="<name>_twin")
@seed_option
@duration_option
@set_option
@storage_options
@json_option
def simulate(
    experiment: Path,
    *,
    out: Path | None,
    seed: int | None,
    duration: float | None,
    changes: tuple[str, ...],
    storage: Storage,
    as_json: bool,
) -> None:
    """Simulate EXPERIMENT without ROS and write its bag.

    The name of the bag is printed. A network run of EXPERIMENT with the same seed has the same states.
    """
    loaded = load_experiment(experiment, changes)
    directory = out or Path(f"{loaded.name}_twin")
    if directory.exists():
        raise InputError(f"{directory}: exists already: remove it, or choose another name with --out")
    run = loaded.simulate(seed=seed, duration=duration)
    run.save(directory, storage)
    if as_json:
        made = {"bag": str(directory), "run": str(run.record.run), "experiment": loaded.name}
        print_json(made | {"seed": run.experiment.run.seed, "steps": run.experiment.steps})
    else:
        click.echo(directory)


@click.command(
    epilog=examples(
        "msg-analysis leaders line_ring --count 2", "msg-analysis leaders line_ring --count 2 --gain 0.5 --json"
    )
)
@experiment_argument
@click.option("--count", type=int, metavar="K", show_default="as many as EXPERIMENT has", help="Number of leaders.")
@choice_option(
    "--method",
    ["auto", "exhaustive", "greedy", "swap"],
    "Search method. auto: exhaustive up to 1000 sets, otherwise swap.",
    default="auto",
)
@choice_option(
    "--law", ["continuous", "emulated", "discrete"], "Law of the agents.", show_default="the paper's, if there is one"
)
@click.option(
    "--gain",
    type=float,
    metavar="KAPPA",
    show_default="that of EXPERIMENT's leaders, else inf",
    help="Gain of the leaders; inf: states held fixed.",
)
@click.option("--top", type=int, metavar="N", default=10, help="Number of sets to list.")
@set_option
@json_option
def leaders(experiment: Path, *, count: int | None, changes: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Find the best leaders for the network of EXPERIMENT.

    Sets of leaders are compared by joint robustness centrality. The leaders in EXPERIMENT are shown beside them.
    """
    from msg_analysis.cli.console import SolveProgress
    from msg_analysis.report.theory_text import print_leaders

    loaded = load_experiment(experiment, changes)
    with SolveProgress(loaded.name) as progress:
        selection = loaded.leaders(count, **options, watch=progress)
    document = selection.to_json()
    print_result(document, print_leaders, as_json=as_json)


@click.command(
    epilog=examples(
        "msg-analysis figures", "msg-analysis figures 3 --out paper --format pdf", "msg-analysis figures 1 --emulate"
    )
)
@click.argument("example", type=click.Choice(["1", "2", "3", "all"]), default="all")
@out_option("DIR", "Output directory.", default=Path("figures"))
@click.option(
    "--format",
    "formats",
    type=click.Choice(FORMATS),
    multiple=True,
    default=FORMATS,
    help="Format of the figures. Repeatable.",
)
@click.option("--emulate", is_flag=True, help="Also run networks (takes minutes) and draw the measured values.")
@sweep.other_software
@json_option
@click.pass_context
def figures(
    context: click.Context,
    example: str,
    out: Path,
    formats: tuple[str, ...],
    *,
    emulate: bool,
    other_software: OtherSoftware,
    as_json: bool,
) -> None:
    """Draw the figures of the paper, and write their numbers.

    The names of the files are printed; existing files of these names are replaced. With --emulate, networks are
    run, and the measured points are drawn on the curves in separate files; finished runs are kept. Exit code 1: some
    point disagrees with theory, 3: some network failed.
    """
    from msg_analysis.paper.figures import write_figures

    plain_matplotlib()
    numbers = (1, 2, 3) if example == "all" else (int(example),)
    chosen = tuple(dict.fromkeys(formats))
    if emulate:
        context.exit(sweep.emulate(context, numbers, out, chosen, other_software, as_json=as_json))
    written: list[str] = []
    for number in numbers:
        for path in write_figures([number], out, chosen):
            written.append(str(path))
            if not as_json:
                click.echo(path)
    if as_json:
        print_json({"files": written})


@click.command(
    epilog=examples("msg-analysis info line_ring", "msg-analysis info runs/line_ring_20250101_120000 --json")
)
@click.argument("source", metavar="EXPERIMENT|BAG", type=SOURCE)
@json_option
def info(source: Path, as_json: bool) -> None:
    """Describe an experiment file or a bag."""
    from msg_analysis.report import tables
    from msg_analysis.report.documents import describe_bag, describe_experiment

    if is_bag(source):
        document, show = describe_bag(source), tables.print_bag
    else:
        document, show = describe_experiment(load_experiment(source)), tables.print_experiment
    print_result(document, show, as_json=as_json)


@click.command(epilog=examples("msg-analysis salvage runs/line_ring_20250101_120000 whole"))
@click.argument("bag", type=BAG)
@click.argument("out", type=PATH)
@json_option
def salvage(bag: Path, out: Path, *, as_json: bool) -> None:
    """Recover the intact part of a torn or damaged bag.

    It is written to OUT, which must not exist; what was dropped is reported. BAG is not changed.
    """
    from msg_analysis.bags.salvage import salvage as salvage_bag
    from msg_analysis.report.documents import describe_salvage
    from msg_analysis.report.tables import print_salvage

    document = describe_salvage(out, salvage_bag(bag, out))
    print_result(document, print_salvage, as_json=as_json)


@click.command(
    epilog=examples(
        "msg-analysis export runs/line_ring_20250101_120000 --parquet",
        "msg-analysis export line_ring_twin --csv --npz --out data",
        "msg-analysis export robots --map map.yaml --csv",
    )
)
@click.argument("bag", type=LOG)
@click.option("--map", "mapped", type=YAML, metavar="MAP", help="Of a bag or table of others: where its states are.")
@click.option("--csv", is_flag=True, help="Write states.csv, graphs.csv and errors.csv.")
@click.option("--parquet", is_flag=True, help="Write states.parquet, graphs.parquet and errors.parquet.")
@click.option("--npz", is_flag=True, help="Write run.npz, the arrays of Python.")
@click.option("--rrd", is_flag=True, help="Write run.rrd, a recording for the viewer Rerun; needs rerun-sdk.")
@out_option("DIR", "Output directory.", show_default="<name of BAG>_export")
@json_option
def export(
    bag: Path, *, mapped: Path | None, csv: bool, parquet: bool, npz: bool, rrd: bool, out: Path | None, as_json: bool
) -> None:
    """Convert a bag to CSV, Parquet, NumPy or Rerun files.

    The names of the files are printed; existing files of these names are replaced. Exit code 3: states or graphs of
    the run are missing. With --map, BAG is a log of others; it gives states, graphs and log.npz.
    """
    if csv or parquet:
        from msg_analysis.common.resources import pyarrow_problem

        pyarrow_problem()  # loads it before the progress of the work begins

    from msg_analysis.bags.reading import read_bag
    from msg_analysis.cli.console import WorkProgress
    from msg_analysis.common.resources import watched
    from msg_analysis.errors import ExitCode
    from msg_analysis.report.export import FORMS, export_run, require_rerun

    forms = [form for form, wanted in zip(FORMS, (csv, parquet, npz, rrd), strict=True) if wanted]
    if not forms:
        raise InputError("no format: expected at least one of --csv, --parquet, --npz, --rrd")
    if rrd and mapped:
        raise InputError("--rrd: with --map: expected --csv, --parquet or --npz")
    if rrd:
        require_rerun()
    directory = out or Path(f"{bag.resolve().name.partition('.')[0]}_export")
    if mapped:
        logs.export_mapped(bag, mapped, directory, forms, as_json=as_json)
        return
    with WorkProgress() as progress, watched(progress):
        run = read_bag(bag)
        files = [str(file) for file in export_run(run, directory, forms)]
    count = run.completeness
    if as_json:
        print_json({"run": str(run.record.run), "files": files, "missing": count.missing + count.missing_modes})
    else:
        print_text("\n".join(files))
    if not count.complete:
        complain(f"{bag}: {count.missing} states and {count.missing_modes} graphs are missing: empty there", "warning:")
        sys.exit(ExitCode.INCOMPLETE)


@click.command(
    epilog=examples("msg-analysis schema > experiment.schema.json", "msg-analysis schema sweep > sweep.schema.json")
)
@click.argument("what", type=click.Choice(["experiment", "sweep", "map"]), default="experiment")
def schema(what: str) -> None:
    """Print the JSON Schema of a kind of file, for editors."""
    if what == "sweep":
        from msg_analysis.sweeps.grid import json_schema
    elif what == "map":
        from msg_analysis.bags.log_map import json_schema
    else:
        from msg_analysis.experiment.spec import json_schema

    print_json(json_schema(), indent=2)


main.add_section("Start here", predict, simulate, runs.compare, theory.plan, schema)
main.add_section("Runs", runs.runs, runs.tabulate, runs.diff, sweep.sweep)
main.add_section("Bags", info, export, salvage, logs.map_)
main.add_section("Theory", theory.transient, theory.spectrum, leaders, theory.facts, figures)


if __name__ == "__main__":
    main(prog_name="msg-analysis")
