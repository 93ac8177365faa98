"""Dense networks in lockstep: states between processes in batches, and on a topic for each agent.

Random regular graphs and complete graphs, alternating with a ring, not recorded, each run twice and short; start-up is
the time from the call to the last agent's x(0). A hundred agents that all hear each other do not get beyond the first
steps with a topic for each.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import networkx as nx

from msg_agents.nodes.agent_group import ONLY_TOPICS
from msg_agents.run.runner import run_network
from msg_analysis.experiment.experiment import Experiment

NETWORKS = ((24, 3, 23), (40, 4, 39), (100, 4, 6), (100, 4, 20), (100, 4, 99))  # agents, processes, neighbours
HOPELESS = (100, 4, 99)  # with topics


def experiment(agents: int, processes: int, neighbours: int, steps: int) -> Experiment:
    """A random graph in which everybody has so many neighbours, and a ring."""
    graph = nx.random_regular_graph(neighbours, agents, seed=1)
    return Experiment.parse(
        {
            "name": "dense",
            "graphs": {
                "dense": {"edges": [[i + 1, j + 1] for i, j in graph.edges]},
                "ring": {"cycle": [*range(1, agents + 1)]},
            },
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 5e-4, "duration": 5e-4 * steps, "start": "zero", "seed": 1, "processes": processes},
        }
    )


def measure(what: Experiment, environment: dict[str, str]) -> tuple[float, float]:
    """Start-up [s] and steps per second."""
    begun, start = time.monotonic(), 0.0

    def look(_: int) -> None:
        nonlocal start
        start = start or time.monotonic() - begun

    result = run_network(what, None, environment=environment, on_progress=look)
    if result.failures:
        raise SystemExit("\n".join(result.failures))
    return start, result.rate


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    print("| agents | processes | neighbours | start-up [s], topics | batches | steps/s, topics | batches |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    for network in NETWORKS:
        what = experiment(*network, arguments.steps)
        kinds: list[dict[str, str]] = [{ONLY_TOPICS: "1"}, {}]
        found = [[measure(what, kind) for kind in kinds[network == HOPELESS :]] for _ in range(arguments.rounds)]
        starts = [f"{median(values):.1f}" for values in zip(*([s for s, _ in row] for row in found), strict=True)]
        rates = [f"{median(values):.0f}" for values in zip(*([r for _, r in row] for row in found), strict=True)]
        cells = [*network, *["–"] * (network == HOPELESS), *starts, *["–"] * (network == HOPELESS), *rates]
        print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
