"""Reliable or best effort? Errors of the example line_ring_realtime over lossy channels, measured and predicted.

    python benchmarks/delivery.py [--losses 0,0.05,0.1,0.2,0.4] [--delays 0,5] [--duration 400] [--repetitions 1]

A row for each loss, delay [ms] and delivery, as a table for docs/delivery.md. Every agent is a host; recorder and
switcher have a clean path, so that only states are lost and late. Predicted before the run: agents one after the other,
on time, each message lost on its own, the last value heard in place of a lost one (reliable: nothing lost). Needs root,
and a machine that does nothing else: what is late because the machine is busy counts like what is late on the channel.
The default takes 35 minutes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from msg_agents.channel.channel_file import Channel
from msg_agents.run.result import RunResult, conclude
from msg_agents.run.runner import run_network
from msg_analysis.errors import InputError
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict

COLUMNS = (
    "loss",
    "delay [ms]",
    "delivery",
    "predicted before the run",
    "predicted given the log",
    "measured ± (95 %)",
    "verdict",
    "age of values, median / 95 % [ms]",
    "deadlines missed",
    "packets",
)
BUSY = 0.5  # other processes that want to run, on average


def predicted(experiment: Experiment, loss: float) -> float | None:
    """The system error with the last value heard in place of lost ones; None where this version cannot say."""
    document = experiment.to_document()
    if loss:
        document["noise"] |= {"loss": loss, "on_loss": "hold"}
    try:
        return float(predict(Experiment.parse(document)).emulated.system_error)
    except InputError:
        return None


def measure(experiment: Experiment, loss: float, delay: float, folder: Path) -> RunResult:
    """One run, compared."""
    link = {"loss": loss, "delay_ms": delay}
    document = {"seed": experiment.run.seed, "default": link, "recorder": "clean"}
    result = run_network(experiment, folder, channel=Channel.parse(document, experiment))
    if result.failures:
        raise InputError("; ".join(result.failures))
    conclude(result, "never")
    return result


def row(experiment: Experiment, loss: float, delay: float, repetitions: int, folder: Path) -> list[str]:
    """Cells of the table: means over the repetitions, each with a seed of its own."""
    documents: list[dict[str, Any]] = []
    packets = 0
    for repetition in range(repetitions):
        result = measure(experiment.with_run(seed=experiment.run.seed + repetition), loss, delay, folder)
        assert result.comparison is not None
        assert result.channel is not None
        documents.append(result.comparison.to_json())
        packets += sum(pair["sent"] for pair in result.channel["pairs"])
    delivery = experiment.run.delivery or "best_effort"
    before = predicted(experiment, 0.0 if delivery == "reliable" else loss)
    errors = [document["system_error"] for document in documents]
    spread = 1.96 * np.sqrt(sum((error["standard_error"] or np.nan) ** 2 for error in errors)) / repetitions
    verdicts = sorted({document["verdict"] for document in documents})
    timing = [document["timing"] for document in documents]
    ages = [np.mean([found["staleness_ms"][quantile] for found in timing]) for quantile in ("p50", "p95")]
    return [
        f"{loss:.0%}",
        f"{delay:g}",
        delivery.replace("_", " "),
        "-" if before is None else f"{before:.3f}",
        f"{np.mean([error['predicted'] for error in errors]):.3f}",
        f"{np.mean([error['measured'] for error in errors]):.3f} ± {spread:.3f}",
        ", ".join(verdicts),
        f"{ages[0]:.1f} / {ages[1]:.1f}",
        f"{np.mean([found['deadlines']['share'] for found in timing]):.2%}",
        str(packets // repetitions),
    ]


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--losses", default="0,0.05,0.1,0.2,0.4")
    parser.add_argument("--delays", default="0,5")
    parser.add_argument("--duration", type=float, default=400.0)
    parser.add_argument("--repetitions", type=int, default=1)
    options = parser.parse_args()
    load = os.getloadavg()[0]
    if load > BUSY:
        print(f"this machine is busy (load {load:.1f}): agents will be late for other reasons", file=sys.stderr)
    experiment = Experiment.load(find("line_ring_realtime"))
    losses, delays = ([float(word) for word in words.split(",")] for words in (options.losses, options.delays))
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for delay, loss, delivery in product(delays, losses, ("best_effort", "reliable")):
            what = experiment.with_run(duration=options.duration, delivery=delivery)
            print(f"| {' | '.join(row(what, loss, delay, options.repetitions, Path(folder)))} |", flush=True)


if __name__ == "__main__":
    main()
