"""Experiments, runs, and what is observed of them. In all: ``run`` is merged, other keys are replaced.

What most tests need of the package is imported from here, so that one place says where it is.
"""

import dataclasses
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.links import with_logged
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.pool import compare as compare
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.theory.prediction import Prediction, predict
from msg_analysis.twin.check import check as check
from msg_analysis.twin.simulate import new_record as new_record
from msg_analysis.twin.simulate import simulate

GOLDEN = Path(__file__).parents[1] / "data/golden"
CORRELATED = [[1.0, 0.3, 0.0], [0.0, 0.5, 0.2], [0.0, 0.0, 2.0]]
"""Noise gains F of three agents."""
TRACKING: dict[str, Any] = {"problem": "tracking", "leaders": {"agents": [1], "gain": 0.7, "reference": 2.0}}
DIRECTED = {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[1, 2], [2, 3, 2.0], [3, 1], [1, 3]]}}


def document(agents: int = 3, rate: float = 1.0, /, **changes: Any) -> dict[str, Any]:
    """Agents on a line and a ring, each left at this rate."""
    everybody = list(range(1, agents + 1))
    dt = 1.0 if changes.get("time") == "discrete" else 0.05
    run = {"dt": dt, "duration": 20, "replicas": 2} | changes.pop("run", {})
    return {
        "name": "net",
        "graphs": {"line": {"path": everybody}, "ring": {"cycle": everybody}},
        "switching": {"generator": [[-rate, rate], [rate, -rate]]},
        **changes,
        "run": run,
    }


def line_ring(agents: int = 3, rate: float = 1.0, /, **changes: Any) -> Experiment:
    return Experiment.parse(document(agents, rate, **changes))


def five(seed: int = 1, duration: float = 100.0, **changes: Any) -> Experiment:
    """Five agents, one replica."""
    run = {"duration": duration, "replicas": 1, "seed": seed} | changes.pop("run", {})
    return line_ring(5, 0.5, **changes, run=run)


def directed(**changes: Any) -> Experiment:
    """Three agents on a path and on weighted arcs."""
    run = {"dt": 0.1, "duration": 40, "seed": 3} | changes.pop("run", {})
    changes = {"graphs": DIRECTED, "switching": {"generator": [[-1.0, 1.0], [2.0, -2.0]]}} | changes
    return line_ring(run=run, **changes)


def pieces(**changes: Any) -> Experiment:
    """Three agents, of which 1 and 3 lead, and one link at a time."""
    run = {"dt": 0.1, "duration": 3, "seed": 3} | changes.pop("run", {})
    fields = {
        "problem": "tracking",
        "graphs": {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0]]}},
        "switching": {"generator": [[-2.0, 2.0], [1.0, -1.0]]},
        "noise": {"process": CORRELATED},
        "leaders": {"agents": [1, 3], "gain": 1.5, "reference": 2.0},
    }
    return line_ring(**fields | {"agents": 3} | changes, run=run)


def golden(name: str, **run: Any) -> Experiment:
    """An experiment of tests/data/golden."""
    return Experiment.load(GOLDEN / f"{name}.yaml").with_run(**run)


def changed(experiment: Experiment, **changes: Any) -> Experiment:
    """The same but for these keys."""
    return experiment.parse(experiment.to_document() | changes)


def observed(of: Run | Experiment, law: Experiment | Prediction | None = None) -> Observation:
    """A run, or that of the twin, beside the prediction of its own experiment or of another law."""
    run = of if isinstance(of, Run) else simulate(of)
    law = law or run.record.experiment
    return Observation.of(run, law if isinstance(law, Prediction) else predict(law))


def claimed(run: Run, experiment: Experiment) -> Run:
    """The same data, recorded as those of another experiment."""
    return dataclasses.replace(run, record=RunRecord(run.record.run, experiment, run.record.start))


def cut(run: Run, step: int) -> Run:
    """The same run with x(step..) and g(step..) lost."""
    states, modes = run.states.copy(), run.modes.copy()
    states[step:], modes[step:] = np.nan, -1
    missing, count = int(np.isnan(states[:, :, 0]).sum()), states[:, :, 0].size
    completeness = Completeness(count, count - missing, missing, missing_modes=int((modes < 0).sum()))
    return dataclasses.replace(run, states=states, modes=modes, completeness=completeness)


def chain_path(transition: Sequence[Sequence[float]], steps: int, seed: int) -> np.ndarray:
    """Graphs (steps,) of a Markov chain from 0."""
    random, up_to = np.random.default_rng(seed).random(steps), np.cumsum(transition, axis=1)[:, :-1].tolist()
    path = [0]
    for chance in random[1:].tolist():
        path.append(bisect_right(up_to[path[-1]], chance))
    return np.array(path)


def late(run: Run, nanoseconds: int) -> Run:
    """Every step of every agent is late by so much simulated time."""
    made = run.made.copy()
    made[1:] += nanoseconds
    return dataclasses.replace(run, made=made)


def stored(run: Run, directory: Path) -> Run:
    """Written to a bag and read again."""
    write_trajectory(run, directory / "bag")
    return read_bag(directory / "bag")


def flipped(states: FloatArray, *where: int) -> FloatArray:
    """The last bit of one number turned over."""
    copy = states.copy()
    copy.view(np.uint64)[where] ^= np.uint64(1)
    return copy


def logged(run: Run, experiment: Experiment) -> Run:
    """The same log, recorded as that of another experiment whose links switch, or whose agents leave out steps."""
    claims = with_logged(experiment, run.record.experiment.graph_list, run.modes)
    return dataclasses.replace(run, record=dataclasses.replace(run.record, experiment=claims))
