"""How long until the system error of the demo network is known to 1 %? Start-up, recording and comparison included.

All replicas of a state share the graph path, so beyond some number more of them only make messages longer: what is left
is the uncertainty of the path. For each number of replicas the length of the run comes from a short run of the twin,
whose standard error falls with the square root of the length; then the real network is run, and what it gives counts.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path

from msg_agents.run.runner import run_network
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.pool import compare
from msg_analysis.twin.simulate import simulate

EXPERIMENT = Path(__file__).parents[1] / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"
REPLICAS = (16, 64, 256)
TARGET = 0.01
PILOT = 4000.0  # simulated time units of the twin
MARGIN = 1.1
"""In length. The standard error is an estimate too: in runs of this length it comes out a few per cent up or down."""


def with_run(**changes: object) -> Experiment:
    """The demo experiment with another ``run`` section."""
    document = Experiment.load(EXPERIMENT).to_document()
    document["run"] |= changes
    return Experiment.parse(document)


def length_needed(replicas: int) -> float:
    """Simulated time units after which the standard error is the target, with a margin; a whole number."""
    error = compare(simulate(with_run(duration=PILOT, replicas=replicas, seed=1))).system_error
    assert error.standard_error
    assert error.predicted
    return math.ceil(MARGIN * PILOT * (error.standard_error / error.predicted / TARGET) ** 2)


def measure(replicas: int, processes: str | int) -> dict[str, float]:
    """Run the network for as long as it takes, and compare."""
    experiment = with_run(duration=length_needed(replicas), replicas=replicas, processes=processes)
    with tempfile.TemporaryDirectory() as directory:
        started = time.monotonic()
        result = run_network(experiment, Path(directory))
        if result.trajectory is None:
            raise SystemExit("\n".join(result.failures))
        error = compare(result.trajectory).system_error
        elapsed = time.monotonic() - started
    assert error.standard_error
    assert error.predicted
    return {
        "replicas": replicas,
        "steps": experiment.steps,
        "steps/s": round(result.rate),
        "standard error [%]": round(100 * error.standard_error / error.predicted, 2),
        "time [s]": round(elapsed, 1),
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicas", type=int, nargs="+", default=REPLICAS)
    parser.add_argument("--processes", default="one_per_agent", help="of the five agents (default: one each)")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    processes = int(arguments.processes) if arguments.processes.isdigit() else arguments.processes
    rows = [measure(replicas, processes) for replicas in arguments.replicas]
    if arguments.json:
        print(json.dumps(rows))
        return
    print("  ".join(f"{title:>18}" for title in rows[0]))
    for row in rows:
        print("  ".join(f"{value:18g}" for value in row.values()))


if __name__ == "__main__":
    main()
