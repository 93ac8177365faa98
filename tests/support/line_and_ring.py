"""Five agents on a line and a ring, for tests of evidence and of intervals."""

from __future__ import annotations

from typing import Any

from msg_analysis.experiment.experiment import Experiment


def experiment(seed: int = 1, duration: float = 100.0, **changes: Any) -> Experiment:
    """Of one replica; ``run`` is merged, other keys are replaced."""
    run = {"dt": 0.05, "duration": duration, "replicas": 1, "seed": seed} | changes.pop("run", {})
    return Experiment.parse(
        {
            "name": "net",
            "problem": "consensus",
            "time": "continuous",
            "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
            "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
            "run": run,
            **changes,
        }
    )
