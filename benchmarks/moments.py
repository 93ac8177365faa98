"""How fast second moments are computed: side by side with dense formulas and with one Lyapunov solve per graph.

One thread of linear algebra, CPU time. Graphs are rings with random chords, m of them; rates are random, about 1, and
symmetric; F = I. Every row is measured in this run; times are the best of a few, beside scipy medians of calls in turn;
memory is the peak of a process of its own. Prints Markdown: the comparisons, then the cost over m and n with fitted
exponents; takes about two minutes (--quick: a quarter of one). --plot FILE.svg draws the cost.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.markov_chain import Time, stationary_law
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver

DT = 0.02
"""Length of a step in discrete time."""


@dataclass(frozen=True, slots=True)
class Network:
    """Graphs and rates of one case."""

    laplacians: FloatArray
    generator: FloatArray

    @classmethod
    def random(cls, agents: int, graphs: int, seed: int = 1) -> Network:
        """Rings in random order with as many random chords."""
        random = np.random.default_rng(seed)
        adjacency = np.zeros((graphs, agents, agents))
        for a in adjacency:
            order = random.permutation(agents)
            first = np.concatenate([order, random.integers(agents, size=agents)])
            second = np.concatenate([np.roll(order, 1), random.integers(agents, size=agents)])
            a[first, second] = a[second, first] = 1.0
            np.fill_diagonal(a, 0.0)
        rates = random.uniform(0.5, 1.5, (graphs, graphs))
        rates = 0.5 * (rates + rates.T)
        np.fill_diagonal(rates, 0.0)
        degrees = adjacency.sum(axis=2)[:, :, None] * np.eye(agents)
        return cls(degrees - adjacency, rates - np.diag(rates.sum(axis=1)))

    def system(self, when: Time) -> JumpSystem:
        """The reduced system of consensus."""
        n, m, _ = self.laplacians.shape
        lift = scipy.linalg.helmert(m).T
        matrices = lift.T @ self.laplacians @ lift
        noise = np.stack([np.eye(m - 1)] * n)
        law = stationary_law(self.generator)
        if when == "continuous":
            return JumpSystem(when, matrices, noise, self.generator, law, lift)
        transition = scipy.linalg.expm(self.generator * DT)
        return JumpSystem(when, np.eye(m - 1) - DT * matrices, DT * noise, transition, law, lift)

    def grounded(self, leader: int) -> JumpSystem:
        """Tracking with one leader of infinite gain, continuous time: its row and column are deleted."""
        n, m, _ = self.laplacians.shape
        keep = np.delete(np.arange(m), leader)
        noise = np.stack([np.eye(m - 1)] * n)
        matrices = self.laplacians[:, keep[:, None], keep]
        lift = np.eye(m)[:, keep]
        return JumpSystem("continuous", matrices, noise, self.generator, stationary_law(self.generator), lift)


def steady(system: JumpSystem) -> FloatArray:
    """(n, d, d) by the solver, set-up included."""
    return MomentSolver(system).steady()


def dense_formula(network: Network, when: Time) -> FloatArray:
    """(m, m) by the paper's formula, and its twin in discrete time: the pseudo-inverse of an n m^2 matrix."""
    n, m, _ = network.laplacians.shape
    projector, law = np.eye(m) - 1 / m, stationary_law(network.generator)
    both = np.kron(projector, projector)
    noise = np.concatenate([share * projector.ravel() for share in law])
    if when == "continuous":
        blocks = [np.kron(z, np.eye(m)) + np.kron(np.eye(m), z) for z in network.laplacians]
        matrix = scipy.linalg.block_diag(*blocks) - np.kron(network.generator.T, both)
        solution = np.linalg.pinv(matrix, rcond=1e-11) @ noise
    else:
        flow = np.kron(scipy.linalg.expm(network.generator * DT).T, np.eye(m * m))
        steps = projector @ (np.eye(m) - DT * network.laplacians)
        matrix = np.eye(n * m * m) - flow @ scipy.linalg.block_diag(*[np.kron(w, w) for w in steps])
        solution = np.linalg.pinv(matrix) @ (flow @ (DT * noise))
    return np.asarray(solution.reshape(n, m, m).sum(axis=0))


def uncoupled(system: JumpSystem) -> None:
    """One scipy solve per graph, as if there were no switching."""
    solve = (
        scipy.linalg.solve_continuous_lyapunov if system.time == "continuous" else scipy.linalg.solve_discrete_lyapunov
    )
    for matrix, noise in zip(system.matrices, system.noise, strict=True):
        solve(matrix, noise)


def best(function: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest of some calls."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        times.append(time.process_time() - began)
    return min(times)


def side_by_side(one: Callable[[], object], other: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median seconds of two functions that are called in turn, so that disturbances meet both."""
    pairs = [(best(one, 1), best(other, 1)) for _ in range(repeats)]
    first, second = np.median(pairs, axis=0)
    return float(first), float(second)


def alone(agents: int, graphs: int, when: Time) -> tuple[float, float, int]:
    """(seconds, peak memory in GB, iterations) of one solve; to be called in a fresh process."""
    with threadpool_limits(1):
        system = Network.random(agents, graphs).system(when)
        began = time.process_time()
        solver = MomentSolver(system)
        solver.steady()
        seconds = time.process_time() - began
    assert solver.report is not None
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9, solver.report.iterations


def in_fresh_process(agents: int, graphs: int, when: Time) -> tuple[float, float, int]:
    """The same, there."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(alone, (agents, graphs, when))


def row(case: str, seconds: float, rival: str = "", other: float | None = None, note: str = "") -> str:
    """One line of the table."""
    times = "" if other is None else f"{other:.3g}"
    ratio = "" if other is None else f"{other / seconds:.3g}"
    return f"| {case} | {seconds:.3g} | {rival} | {times} | {ratio} | {note} |"


def comparisons(*, quick: bool) -> Iterator[str]:
    """Lines of the first table."""
    whens: tuple[Time, ...] = ("continuous", "discrete")
    for when in whens:
        network = Network.random(20, 3)
        system = network.system(when)
        seconds = best(lambda system=system: steady(system), 20)  # type: ignore[misc]
        began = time.process_time()
        reference = dense_formula(network, when)
        other = time.process_time() - began
        error = np.abs(system.lifted(steady(system).sum(axis=0)) - reference).max() / np.abs(reference).max()
        yield row(f"20 agents, 3 graphs, {when}", seconds, "`pinv` of the n m² matrix", other, f"differ by {error:.0e}")
    agents = 100 if quick else 300
    for when in whens:
        system = Network.random(agents, 5).system(when)
        seconds, other = side_by_side(
            lambda system=system: steady(system),  # type: ignore[misc]
            lambda system=system: uncoupled(system),  # type: ignore[misc]
            7,
        )
        rival = f"scipy `solve_{when}_lyapunov`, 5 graphs uncoupled"
        yield row(f"{agents} agents, 5 graphs, {when}", seconds, rival, other)
    if not quick:
        for when in whens:
            seconds, memory, iterations = in_fresh_process(1000, 4, when)
            yield row(f"1000 agents, 4 graphs, {when}", seconds, note=f"{memory:.2f} GB, {iterations} iterations")
    network = Network.random(60, 4)
    seconds = best(lambda: [steady(network.grounded(leader)) for leader in range(60)], 1)
    yield row("60 agents, 4 graphs, each agent as the only leader", seconds, note="60 solves")


def cost(sizes: list[tuple[int, int]], when: Time) -> list[float]:
    """Seconds for each (m, n)."""
    times = []
    for agents, graphs in sizes:
        system = Network.random(agents, graphs).system(when)
        times.append(best(lambda system=system: steady(system), 3 if agents < 400 else 1))  # type: ignore[misc]
    return times


def exponent(sizes: list[int], times: list[float]) -> float:
    """Slope of the least-squares line through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def plot(
    path: Path,
    over_agents: dict[Time, list[float]],
    agents: list[int],
    over_graphs: dict[Time, list[float]],
    graphs: list[int],
) -> None:
    """The cost over m and over n, log-log, beside m^3 and n."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "moments"
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.4), layout="constrained", sharey=True)
    for axes, sizes, measured, power, label in (
        (left, agents, over_agents, 3, "agents m (4 graphs)"),
        (right, graphs, over_graphs, 1, "graphs n (100 agents)"),
    ):
        for when, times in measured.items():
            axes.loglog(sizes, times, "o-", label=when)
        scale = next(iter(measured.values()))[-1]
        guide = [scale * (size / sizes[-1]) ** power for size in sizes]
        axes.loglog(sizes, guide, "k:", label="m³" if power == 3 else "n")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.minorticks_off()
        axes.set_xlabel(label)
        axes.legend(frameon=False)
    left.set_ylabel("time [s], one thread")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smaller sizes")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="draw the cost over m and n")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        print("| case | time [s] | compared with | time [s] | ratio | |")
        print("|---|---:|---|---:|---:|---|")
        for line in comparisons(quick=arguments.quick):
            print(line, flush=True)
        agents = [25, 50, 100, 200] if arguments.quick else [50, 100, 200, 400, 800]
        graphs = [2, 4, 8, 16]
        over_agents: dict[Time, list[float]] = {}
        over_graphs: dict[Time, list[float]] = {}
        print("\n| time [s] | " + " | ".join(f"m = {m}" for m in agents) + " | exponent of m | ", end="")
        print(" | ".join(f"n = {n}" for n in graphs) + " | exponent of n |")
        print("|---|" + "---:|" * (len(agents) + len(graphs) + 2))
        whens: tuple[Time, ...] = ("continuous", "discrete")
        for when in whens:
            over_agents[when] = cost([(m, 4) for m in agents], when)
            over_graphs[when] = cost([(100, n) for n in graphs], when)
            large = agents[-3:]
            cells = [f"{t:.3g}" for t in over_agents[when]]
            cells.append(f"{exponent(large, over_agents[when][-3:]):.2f} (m ≥ {large[0]})")
            cells += [f"{t:.3g}" for t in over_graphs[when]]
            cells.append(f"{exponent(graphs, over_graphs[when]):.2f}")
            print(f"| {when} | " + " | ".join(cells) + " |", flush=True)
    if arguments.plot:
        plot(arguments.plot, over_agents, agents, over_graphs, graphs)


if __name__ == "__main__":
    main()
