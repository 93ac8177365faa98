"""Lockstep speed of the demo network beside the bare middleware, in one run.

Each round measures every configuration once, in turn, so that a drift of the machine hits all of them alike; the
ratios are taken within a round and the median over the rounds is what counts.

The network's processes ask the scheduler for throughput (SCHED_BATCH), and keep to one core each where there are fewer
cores than processes. The bare loop does so only where it says so: against the plain one, these choices count for the
network; against the others, what the network costs shows.

Where agents share a process the bare loop still sends every message through the middleware; the network does not, and
can be faster than that. Such a ratio above 1 says nothing of what a message costs: the ratio of 5 processes does.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import bare_loop

from msg_agents.run.runner import run_network
from msg_analysis.experiment.experiment import Experiment

EXPERIMENT = Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"
LARGE, PROCESSES = 100, 4  # agents, and the processes that they share
RATIOS = {
    "network / bare loop": ("network", "bare loop"),
    "network / bare loop, both recorded": ("network, recorded", "bare loop, recorded"),
    "network / bare loop, batch": ("network", "bare loop, batch"),
    "network / bare loop, batch, both recorded": ("network, recorded", "bare loop, batch, recorded"),
    "network / bare loop, batch and pinned": ("network", "bare loop, batch and pinned"),
    "network / bare loop, batch and pinned, both recorded": (
        "network, recorded",
        "bare loop, batch and pinned, recorded",
    ),
    "5 agents in 1 process, network / bare loop": (
        "5 agents in 1 process, network",
        "5 agents in 1 process, bare loop",
    ),
    "100 agents in 4 processes, network / bare loop": (
        "100 agents in 4 processes, network",
        "100 agents in 4 processes, bare loop",
    ),
    "100 agents in 4 processes, both recorded": (
        "100 agents in 4 processes, network, recorded",
        "100 agents in 4 processes, bare loop, recorded",
    ),
    "network, recorded / not recorded": ("network, recorded", "network"),
    "100 agents in 4 processes, recorded / not recorded": (
        "100 agents in 4 processes, network, recorded",
        "100 agents in 4 processes, network",
    ),
    "network / network on SingleThreadedExecutor": ("network", "network on SingleThreadedExecutor"),
}


def network(
    steps: int, *, agents: int = 5, processes: int = 5, record: bool = False, executor: str = "events"
) -> float:
    """Steps per second of the demo network, of this many agents, in agent processes beside which the switcher runs."""
    document = Experiment.load(EXPERIMENT).to_document()
    everybody = list(range(1, agents + 1))
    document |= {"agents": agents, "graphs": {"line": {"path": everybody}, "ring": {"cycle": everybody}}}
    document["run"] |= {"duration": round(steps * document["run"]["dt"], 6), "processes": processes}
    experiment = Experiment.parse(document)
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) if record else None
        result = run_network(experiment, out, environment={"MSG_AGENTS_EXECUTOR": executor})
    if result.failures:
        raise SystemExit("\n".join(result.failures))
    return result.rate


def configurations(steps: int) -> dict[str, Callable[[], float]]:
    """What is measured, by name."""
    return {
        "bare loop": lambda: bare_loop.measure(steps=steps),
        "network": lambda: network(steps),
        "bare loop, recorded": lambda: bare_loop.measure(steps=steps, recorder=True),
        "network, recorded": lambda: network(steps, record=True),
        "bare loop, batch": lambda: bare_loop.measure(steps=steps, batch=True),
        "bare loop, batch, recorded": lambda: bare_loop.measure(steps=steps, recorder=True, batch=True),
        "bare loop, batch and pinned": lambda: bare_loop.measure(steps=steps, batch=True, pin=True),
        "bare loop, batch and pinned, recorded": lambda: bare_loop.measure(
            steps=steps, recorder=True, batch=True, pin=True
        ),
        # Scheduled like the network.
        "5 agents in 1 process, bare loop": lambda: bare_loop.measure(processes=1, steps=steps, batch=True, pin=True),
        "5 agents in 1 process, network": lambda: network(4 * steps, processes=1),
        "100 agents in 4 processes, bare loop": lambda: bare_loop.measure(
            agents=LARGE, processes=PROCESSES, steps=steps // 15, batch=True, pin=True
        ),
        "100 agents in 4 processes, network": lambda: network(steps // 4, agents=LARGE, processes=PROCESSES),
        "100 agents in 4 processes, bare loop, recorded": lambda: bare_loop.measure(
            agents=LARGE, processes=PROCESSES, steps=steps // 15, recorder=True, batch=True, pin=True
        ),
        "100 agents in 4 processes, network, recorded": lambda: network(
            steps // 4, agents=LARGE, processes=PROCESSES, record=True
        ),
        "network on SingleThreadedExecutor": lambda: network(steps // 2, executor="single"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=15000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rates: dict[str, list[float]] = {name: [] for name in configurations(arguments.steps)}
    for number in range(arguments.rounds):
        for name, measure in configurations(arguments.steps).items():
            rates[name].append(measure())
            print(f"round {number + 1}: {name}: {rates[name][-1]:.0f} steps/s", file=sys.stderr)
    ratios = {
        title: statistics.median(a / b for a, b in zip(rates[over], rates[under], strict=True))
        for title, (over, under) in RATIOS.items()
    }
    if arguments.json:
        print(json.dumps({"rates": rates, "ratios": ratios}))
        return
    print(f"5 agents in 5 processes where not said otherwise, 16 replicas, {arguments.rounds} rounds")
    print(f"{'steps per second':52} {'median':>8} {'lowest':>8} {'highest':>8}")
    for name, values in rates.items():
        print(f"{name:52} {statistics.median(values):8.0f} {min(values):8.0f} {max(values):8.0f}")
    print(f"{'ratio within a round':52} {'median':>8}")
    for title, ratio in ratios.items():
        print(f"{title:52} {ratio:8.2f}")


if __name__ == "__main__":
    main()
