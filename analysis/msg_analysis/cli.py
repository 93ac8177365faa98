"""The command line ``msg-analysis``: plain functions of the other rooms, one a command.

Results go to stdout, everything else to stderr. Exit codes: 0 fine or agrees, 1 disagrees, 2 bad usage or
input, 3 data incomplete. What takes long to import is imported by the command that needs it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

import msg_analysis
from msg_analysis import cli_compare, cli_sweep, cli_theory
from msg_analysis.cli_storage import storage, storage_options
from msg_analysis.console import CommandGroup, examples, print_json, result_console
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis.bags.storage import Compression
    from msg_analysis.sweep.conduct import OtherSoftware


_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
_experiment = click.argument("experiment", type=click.Path(path_type=Path))


@click.group(cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(msg_analysis.__version__, prog_name="msg-analysis")
def main() -> None:
    """Theory, simulation and statistics of Markov-switching networks of agents."""


@main.command(
    epilog=examples("msg-analysis predict line_ring.yaml", "msg-analysis predict line_ring.yaml --json | jq .emulated")
)
@_experiment
@_json
def predict(experiment: Path, as_json: bool) -> None:
    """Predict the steady errors of EXPERIMENT, exactly."""
    from msg_analysis.model.experiment import Experiment
    from msg_analysis.theory.prediction import predict as predict_experiment

    loaded = Experiment.load(experiment)
    loaded.require_available("predict")
    document = predict_experiment(loaded).to_json()
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.text import print_prediction

        print_prediction(document, result_console())


@main.command(
    epilog=examples(
        "msg-analysis simulate line_ring.yaml", "msg-analysis simulate line_ring.yaml --seed 8 --out twin_8"
    )
)
@_experiment
@click.option("--out", type=click.Path(path_type=Path), help="Bag directory to write; <name>_twin by default.")
@click.option("--seed", type=int, help="Instead of run.seed.")
@click.option("--duration", type=float, help="Instead of run.duration [units of simulated time].")
@storage_options
def simulate(
    experiment: Path,
    out: Path | None,
    seed: int | None,
    duration: float | None,
    compression: Compression,
    split_size: float | None,
) -> None:
    """Run EXPERIMENT without ROS and write its bag, whose name is printed."""
    from msg_analysis.bags.store import write_trajectory
    from msg_analysis.model.experiment import Experiment
    from msg_analysis.twin import simulate as simulate_experiment

    given = {key: value for key, value in {"seed": seed, "duration": duration}.items() if value is not None}
    loaded = Experiment.load(experiment).with_run(**given)
    loaded.require_available()
    directory = out or Path(f"{loaded.name}_twin")
    if directory.exists():
        raise InputError(f"{directory}: exists already: remove it, or choose another name with --out")
    write_trajectory(simulate_experiment(loaded), directory, storage(compression, split_size))
    click.echo(directory)


@main.command(
    epilog=examples(
        "msg-analysis leaders line_ring.yaml --count 2",
        "msg-analysis leaders line_ring.yaml --count 2 --gain 0.5 --json | jq .sets[0].agents",
    )
)
@_experiment
@click.option("--count", type=int, required=True, help="Number of leaders.")
@click.option(
    "--method",
    type=click.Choice(["auto", "exhaustive", "greedy", "swap"]),
    default="auto",
    help="auto (default): exhaustive where there are at most 1000 sets, else swap.",
)
@click.option("--law", type=click.Choice(["continuous", "emulated", "discrete"]), help="By default the paper's.")
@click.option("--gain", type=float, default=float("inf"), help="Pull of the leaders; inf (default) holds them.")
@click.option("--top", type=int, default=10, help="How many sets to list; 10 by default.")
@_json
def leaders(experiment: Path, count: int, method: str, law: str | None, gain: float, top: int, as_json: bool) -> None:
    """Find the best leaders for the network of EXPERIMENT, by joint robustness centrality.

    Leaders that EXPERIMENT names do not count.
    """
    from msg_analysis.model.experiment import Experiment
    from msg_analysis.progress import SolveProgress
    from msg_analysis.theory.leaders import select_leaders

    loaded = Experiment.load(experiment)
    loaded.require_available("predict")
    with SolveProgress(loaded.name) as progress:
        selection = select_leaders(
            loaded,
            count,
            method=method,  # type: ignore[arg-type]  # click has checked it
            law=law,  # type: ignore[arg-type]
            gain=gain,
            top=top,
            watch=progress,
        )
    document = selection.to_json()
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.text import print_leaders

        print_leaders(document, result_console())


@main.command(
    epilog=examples(
        "msg-analysis figures",
        "msg-analysis figures 3 --out paper --format pdf",
        "msg-analysis figures 1 --emulate",
    )
)
@click.argument("example", type=click.Choice(["1", "2", "3", "all"]), default="all")
@click.option("--out", type=click.Path(path_type=Path), default=Path("figures"), help="Directory; figures by default.")
@click.option(
    "--format",
    "formats",
    type=click.Choice(["png", "svg", "pdf"]),
    multiple=True,
    default=("png", "svg", "pdf"),
    help="May be given several times; all three by default.",
)
@click.option(
    "--emulate", is_flag=True, help="Run networks as well (msg-agents, minutes), and draw what they measured."
)
@cli_sweep.other_software
@click.pass_context
def figures(
    context: click.Context,
    example: str,
    out: Path,
    formats: tuple[str, ...],
    *,
    emulate: bool,
    other_software: OtherSoftware,
) -> None:
    """Draw the EXAMPLEs of the paper, with the numbers as CSV; print the files' names.

    Files of the same names in the directory are replaced. With --emulate, real networks are run and their points drawn
    on the curves, in files of their own; what has been run is kept, and exit code 1 says that some point disagrees with
    theory, 3 that some network failed.
    """
    from msg_analysis.report.paper_figures import write_figures

    numbers = (1, 2, 3) if example == "all" else (int(example),)
    chosen = tuple(dict.fromkeys(formats))
    if emulate:
        context.exit(cli_sweep.emulate(context, numbers, out, chosen, other_software))
    for number in numbers:
        for path in write_figures([number], out, chosen):
            click.echo(path)


@main.command(epilog=examples("msg-analysis info line_ring.yaml", "msg-analysis info line_ring_twin --json"))
@click.argument("source", metavar="EXPERIMENT|BAG", type=click.Path(path_type=Path))
@_json
def info(source: Path, as_json: bool) -> None:
    """Explain an experiment file, or say what a bag holds."""
    from msg_analysis.model.experiment import Experiment
    from msg_analysis.report import bag_text, text
    from msg_analysis.report.info import describe_bag, describe_experiment

    if source.is_dir() or ".mcap" in source.suffixes:
        document, show = describe_bag(source), bag_text.print_bag
    else:
        document, show = describe_experiment(Experiment.load(source)), text.print_experiment
    if as_json:
        print_json(document)
    else:
        show(document, result_console())


@main.command(epilog=examples("msg-analysis salvage runs/line_ring_20250101_120000 whole"))
@click.argument("bag", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@_json
def salvage(bag: Path, out: Path, *, as_json: bool) -> None:
    """Make OUT, a valid bag, of what is whole in the torn or damaged BAG; say what was dropped.

    BAG is left as it is; OUT must not exist.
    """
    from msg_analysis.bags.salvage import salvage as salvage_bag
    from msg_analysis.report.info import describe_salvage

    document = describe_salvage(out, salvage_bag(bag, out))
    if as_json:
        print_json(document)
    else:
        from msg_analysis.report.bag_text import print_salvage

        print_salvage(document, result_console())


main.add_command(cli_compare.compare)
main.add_command(cli_compare.tabulate)
main.add_command(cli_theory.transient)
main.add_command(cli_theory.facts)
main.add_command(cli_sweep.sweep)


@main.command(
    epilog=examples("msg-analysis schema > experiment.schema.json", "msg-analysis schema sweep > sweep.schema.json")
)
@click.argument("what", type=click.Choice(["experiment", "sweep"]), default="experiment")
def schema(what: str) -> None:
    """Print the JSON Schema of experiment files, or of sweep files, for editors."""
    if what == "sweep":
        from msg_analysis.sweep.spec import json_schema
    else:
        from msg_analysis.model.experiment import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


if __name__ == "__main__":
    main(prog_name="msg-analysis")
