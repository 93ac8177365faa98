"""Leader selection: how long it takes, and how far from the best set it ends: the tables of docs/leader_theory.md.

Random undirected networks: every graph is a ring in random order with half as many random chords, all weights 1;
rates between 0.3 and 2; F = I; leaders held at the reference. One thread. Prints Markdown; takes about a minute and a
half, with --quick a few seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from threadpoolctl import threadpool_limits

from msg_analysis.cli.console import SolveProgress
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.leaders import LeaderProblem, select_leaders


def random_network(seed: int, agents: int, graphs: int) -> Experiment:
    """Rings in random order, with random chords."""
    random = np.random.default_rng(seed)
    documents = {}
    for graph in range(graphs):
        around = (random.permutation(agents) + 1).tolist()
        edges = {(min(i, j), max(i, j)) for i, j in zip(around, [*around[1:], around[0]], strict=True)}
        while len(edges) < 3 * agents // 2:
            i, j = sorted((random.choice(agents, 2, replace=False) + 1).tolist())
            edges.add((i, j))
        documents[f"graph_{graph + 1}"] = {"edges": sorted(edges)}
    rates = random.uniform(0.3, 2.0, (graphs, graphs))
    np.fill_diagonal(rates, 0.0)
    generator = (rates - np.diag(rates.sum(axis=1))).tolist()
    return Experiment.parse({"name": "leaders", "graphs": documents, "switching": {"generator": generator}})


def speed(quick: bool) -> Iterator[str]:
    """One line for each case."""
    agents, graphs = 60, 4
    problem = LeaderProblem(random_network(0, agents, graphs), "continuous")
    began = time.perf_counter()
    for agent in range(agents):
        problem.system_error(frozenset({agent}))
    yield f"| every single leader | {agents}, {graphs}, 1 | {agents} | {time.perf_counter() - began:.2f} | exact |"
    cases = [(40, 3, 3)] if quick else [(40, 3, 3), (100, 3, 5)]
    for agents, graphs, count in cases:
        experiment = random_network(1, agents, graphs)
        for method in ("greedy", "swap"):
            began = time.perf_counter()
            with SolveProgress(f"{agents} agents, {method}") as progress:
                selection = select_leaders(experiment, count, method=method, watch=progress)
            seconds = time.perf_counter() - began
            gap = selection.to_json()["bound"]["gap"]
            size = f"{agents}, {graphs}, {count}"
            yield f"| {method} | {size} | {selection.evaluations} | {seconds:.1f} | at most {100 * gap:.1f} % |"


def quality(cases: int) -> Iterator[str]:
    """Against the best set, by enumeration."""
    agents, graphs, count = 12, 3, 3
    gaps: dict[str, list[tuple[float, float, int]]] = {"greedy": [], "swap": []}
    for seed in range(cases):
        experiment = random_network(100 + seed, agents, graphs)
        best = select_leaders(experiment, count, method="exhaustive").sets[0][0]
        for method, found in gaps.items():
            selection = select_leaders(experiment, count, method=method)  # type: ignore[arg-type]
            assert selection.bound is not None
            assert selection.bound <= best * (1 + 1e-9)
            found.append((selection.sets[0][0] / best - 1, selection.bound / best, selection.evaluations))
    for method, found in gaps.items():
        above, bound, solves = np.array(found).T
        yield (
            f"| {method} | {100 * above.mean():.2f} % | {100 * above.max():.2f} % | "
            f"{int((above < 1e-9).sum())} of {cases} | {bound.min():.2f} .. {bound.max():.2f} | {solves.mean():.0f} |"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smaller cases, and fewer")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        print("| search | agents, graphs, leaders | system errors computed | time [s] | above the best |")
        print("|---|---|---:|---:|---|")
        for line in speed(arguments.quick):
            print(line, flush=True)
        print(
            "\n| search | mean above the best | worst | best set found | bound over best E | system errors computed |"
        )
        print("|---|---:|---:|---|---|---:|")
        for line in quality(5 if arguments.quick else 40):
            print(line, flush=True)


if __name__ == "__main__":
    main()
