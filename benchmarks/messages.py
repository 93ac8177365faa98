"""Predictions message by message: time and memory over agents and channels, and bursts replaced by independent losses.

Prints the tables of docs/accuracy.md, "Messages one by one". One thread; a quarter of an hour with --large.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterable, Mapping
from typing import Any

from threadpoolctl import threadpool_limits

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import build_run_model
from msg_analysis.theory.jump_system import emulated
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.prediction import predict

AIR = {"broadcast": 0.2, "link": 0.3}
HELD = {"loss": 0.3, "on_loss": "hold"}


def network(agents: int, noise: Mapping[str, Any], pace: str = "lockstep", dt: float = 0.1) -> Experiment:
    """A path and a ring."""
    everybody = list(range(1, agents + 1))
    return Experiment.parse(
        {
            "name": "messages",
            "graphs": {"path": {"path": everybody}, "ring": {"cycle": everybody}},
            "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
            "noise": {"process": 1.0, **noise},
            "run": {"dt": dt, "duration": 100 * dt, "pace": pace},
        }
    )


def sizes(agents: Iterable[int]) -> None:
    """Time and memory of one steady solve."""
    print("| agents | law | coordinates | set-up [s] | solve [s] | iterations | claimed error | memory so far [GB] |")
    print("|---:|---|---:|---:|---:|---:|---:|---:|")
    for m in agents:
        for name, experiment in (
            ("real time, own value, noise on the air", network(m, {"loss": 0.3, **AIR}, "realtime")),
            ("lockstep, last value held", network(m, HELD)),
            ("real time, last value held, noise on the air", network(m, HELD | AIR, "realtime")),
        ):
            one(f"{m} | {name}", experiment)


def channels(counts: Iterable[int]) -> None:
    """The same with bursts on some links: line and ring of five agents."""
    links = [[i, i % 5 + 1, 0.3] for i in range(1, 6)] + [[i % 5 + 1, i, 0.3] for i in range(1, 6)]
    print(
        "\n| channels | law | coordinates | set-up [s] | solve [s] | iterations | claimed error | memory so far [GB] |"
    )
    print("|---:|---|---:|---:|---:|---:|---:|---:|")
    for count in counts:
        noise = {"loss": {"arcs": links[:count]}, "burst": 5.0}
        one(f"{count} | own value", network(5, noise))
        one(f"{count} | last value held", network(5, noise | {"on_loss": "hold"}))


def one(name: str, experiment: Experiment) -> None:
    """A row."""
    begin = time.process_time()
    system = emulated(build_run_model(experiment), experiment.problem)
    middle = time.process_time()
    solver = MomentSolver(system)
    solver.steady()
    end = time.process_time()
    assert solver.report is not None
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"| {name} | {system.dimension} | {middle - begin:.2g} | {end - middle:.2g} | {solver.report.iterations} | "
        f"{solver.report.error:.0e} | {memory:.2f} |",
        flush=True,
    )


def bursts() -> None:
    """System error with bursts next to that with independent losses of the same probability."""
    print("\n| loss | burst | in place of a lost value | bursts, exact | independent losses | relative difference |")
    print("|---:|---:|---|---:|---:|---:|")
    for loss in (0.2, 0.5):
        for burst in (5.0, 20.0):
            for on_loss in ("own", "hold"):
                noise = {"loss": {"edges": [[2, 3, loss], [1, 5, loss]]}, "on_loss": on_loss}
                exact, other = (
                    predict(network(5, noise | more, dt=0.05)).emulated.system_error for more in ({"burst": burst}, {})
                )
                numbers = f"{exact:.4f} | {other:.4f} | {100 * (other / exact - 1):+.1f} %"
                print(f"| {loss} | {burst:g} | {on_loss} | {numbers} |")


def main() -> None:
    """All tables."""
    parser = argparse.ArgumentParser(description="Time and accuracy of predictions message by message.")
    parser.add_argument("--large", action="store_true", help="also the largest stacks that are predicted")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        sizes((5, 20, 50, 100, 200, 480) if arguments.large else (5, 20, 50, 100))
        channels((2, 4, 6, 8))
        bursts()


if __name__ == "__main__":
    main()
