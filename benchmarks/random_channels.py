"""Networks over random channels: the verdict in real time, the twin in lockstep, and what the channel lost.

    python benchmarks/random_channels.py [--channels 20] [--seed 1] [--duration 40] [--steps 60]

For each channel (loss 0 to 0.5, in half of them in bursts; delay 0 to 20 ms; both deliveries in turn): the example
line_ring_realtime is run in real time and compared, and line_ring in lockstep and compared with the twin. For both, the
losses of each pair of hosts are counted again with a new link of the same seed, which must lose as many of as many
packets, and z compares their sum with the probability in the file.
Needs root. With --duration 20 --steps 40, a channel takes about a minute.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from msg_agents.channel.channel_file import Channel
from msg_agents.channel.links import Link, PacketOutcome
from msg_agents.run.result import RunResult, conclude
from msg_agents.run.runner import run_network
from msg_analysis.errors import InputError
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.check import check

COLUMNS = ("loss", "burst", "delay [ms]", "delivery", "verdict", "z of losses", "lockstep", "z of losses", "lost again")
MOST_Z = 4.0  # by chance, any of the 40 values of 20 channels is beyond it in 0.25 % of all runs of this benchmark


def random_channel(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """A channel file; every second one has bursts."""
    loss = round(float(rng.uniform(0.0, 0.5)), 3)
    link: dict[str, Any] = {"loss": loss, "delay_ms": round(float(rng.uniform(0.0, 20.0)), 2)}
    if number % 2:
        link["burst"] = round(float(rng.uniform(1.5, 6.0)), 2)
    return {"seed": int(rng.integers(2**32)), "default": link, "recorder": "clean"}


def losses(channel: Channel, counts: dict[str, Any]) -> tuple[float, bool]:
    """z of the packets lost in all pairs, and whether new links lose as many of each pair."""
    places = {name: place for place, name in enumerate(channel.hosts)}
    difference = variance = 0.0
    same = True
    for pair in counts["pairs"]:
        sender, receiver, sent, lost = (pair[key] for key in ("sender", "receiver", "sent", "lost"))
        settings = channel.links[sender, receiver]
        link = Link(settings, channel.seed, places[sender], places[receiver])
        same &= lost == sum(link.carry(0, 0.0)[0] is PacketOutcome.LOST for _ in range(sent))
        model = settings.loss
        difference += lost - sent * model.mean
        variance += sent * model.mean * (1.0 - model.mean) * model.inflation
    return difference / math.sqrt(variance) if variance else 0.0, same


def run(experiment: Experiment, document: dict[str, Any], folder: Path) -> tuple[RunResult, float, bool]:
    """One run, and its losses."""
    channel = Channel.parse(document, experiment)
    result = run_network(experiment, folder, channel=channel)
    if result.failures or result.channel is None:
        raise InputError("; ".join(result.failures))
    return result, *losses(channel, result.channel)


def main() -> None:
    """Print the table, row by row; exit code 1 if a row is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--channels", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=40.0)
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    realtime, lockstep = (Experiment.load(find(name)) for name in ("line_ring_realtime", "line_ring"))
    lockstep = lockstep.with_run(duration=options.steps * lockstep.step_length)
    wrong = 0
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.channels):
            document = random_channel(rng, number)
            delivery = ("best_effort", "reliable")[number // 2 % 2]
            what = realtime.with_run(duration=options.duration, delivery=delivery, seed=options.seed + number)
            result, z, again = run(what, document, Path(folder))
            conclude(result, "never")
            assert result.comparison is not None
            verdict = result.comparison.to_json()["verdict"]
            stepped, other_z, other_again = run(lockstep, document, Path(folder))
            outcome = check(stepped.trajectory) if stepped.trajectory is not None else None
            equal = outcome is not None and outcome.difference is None and not outcome.missing
            right = verdict == "agrees" and equal and again and other_again and max(abs(z), abs(other_z)) < MOST_Z
            wrong += not right
            link = document["default"]
            cells = [
                f"{link['loss']:.1%}",
                f"{link.get('burst', '-')}",
                f"{link['delay_ms']:g}",
                delivery.replace("_", " "),
                verdict,
                f"{z:.2f}",
                "equal to the twin" if equal else "differs",
                f"{other_z:.2f}",
                "the same" if again and other_again else "others",
            ]
            print(f"| {' | '.join(cells)} |", flush=True)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
