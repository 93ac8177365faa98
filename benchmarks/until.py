"""What a run that ends early says: correct runs of the twin, looked at every 100 steps, as `--until` does.

For each rule: how long the runs were, how often the interval at the end misses the prediction, and how often the
verdict on the shorter run is a false alarm. Line and ring at rate 1, four replicas; 0.4 s for each run on an idle core.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import online_errors
from msg_analysis.inference import verdict as verdicts
from msg_analysis.inference.online_errors import LiveEstimate, reached
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import Until
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

EXPERIMENT = {
    "name": "line_ring",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "switching": {"generator": [[-1.0, 1.0], [1.0, -1.0]]},
    "run": {"dt": 0.05, "duration": 500.0, "replicas": 4},
}
LOOK = 100  # steps between two looks


def shorter(run: Run, step: int) -> Run:
    """The run as it would have been recorded if it had ended at this step."""
    if step == len(run.modes):
        return run
    record = run.record.ended(step)
    count = record.experiment.agents * (step + 1)
    return replace(
        run,
        record=record,
        states=run.states[: step + 1],
        modes=run.modes[:step],
        completeness=Completeness(count, count, 0),
        agent_modes=None if run.agent_modes is None else run.agent_modes[: step + 1],
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300)
    runs = parser.parse_args().runs
    experiment = Experiment.parse(EXPERIMENT)
    law = predict(experiment)
    for module in (online_errors, verdicts):  # one prediction for all: they differ in their seeds and lengths only
        module.predict = lambda experiment, *_: replace(law, experiment=experiment)  # type: ignore[attr-defined]
    rules = {"20%": Until(0.2), "decided, at 20%": Until(0.2, decided=True)}
    print("| rule | ended early | steps, median | interval misses | false alarms |\n|---|---:|---:|---:|---:|")
    with threadpool_limits(1):
        found: dict[str, list[tuple[int, bool, bool]]] = {name: [] for name in rules}
        for seed in range(runs):
            whole = simulate(experiment.with_run(seed=seed))
            for name, until in rules.items():
                record = replace(whole.record, until=until)
                live, last = LiveEstimate(record, nodes=False), experiment.steps
                for first in range(0, experiment.steps, LOOK):
                    at = np.arange(first, min(first + LOOK, experiment.steps))
                    live.add_whole(at, whole.modes[at], whole.states[at], whole.states[at + 1])
                    if reached(until, live.report()):
                        last = int(at[-1]) + 1
                        break
                result = verdicts.compare_run(shorter(replace(whole, record=record), last))
                assert result.any_time is not None
                half, error = result.any_time.half_width, result.system_error
                assert half is not None
                assert error.measured is not None
                assert error.predicted is not None
                missed = abs(error.measured - error.predicted) > half
                found[name].append((last, missed, result.verdict == "disagrees"))
    for name, each in found.items():
        steps, missed, alarms = np.array(each).T
        early = int((steps < experiment.steps).sum())
        print(f"| {name} | {early} of {runs} | {int(np.median(steps))} | {missed.sum()} | {alarms.sum()} |")


if __name__ == "__main__":
    main()
