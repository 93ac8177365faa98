# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The comparison of one run with its prediction, or of several runs of one experiment together."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.bags.reading import read_bag
from msg_analysis.errors import InputError
from msg_analysis.experiment.limits import unpredictable
from msg_analysis.inference.comparison import MAX_MISSED, Comparison, Pool, PooledRun, first_difference
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.statistics import chi2_tail
from msg_analysis.inference.verdict import MIN_STEPS, Evidence, compare_run, evaluate, without_numbers
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.theory.prediction import Prediction, predict_run


def compare(*runs: Run | str | Path, level: float = 0.01, max_missed: float = MAX_MISSED) -> Comparison:
    """Compare a run, or several of one experiment, with what theory predicts.

    Parameters
    ----------
    *runs
        runs, or paths of their bags, which are read one after the other; several runs need different seeds and get one
        verdict together
    level
        probability of a false "disagrees", all tests together; above 0, at most 0.5
    max_missed
        in real time: share of missed deadlines above which the verdict is "late"; 0 to 1

    Returns
    -------
    Comparison
        ``verdict``, ``system_error``, ``node_errors``, ``covariance``, ``tests``, ``causes`` and more

    Raises
    ------
    InputError
        no run, an invalid level, runs that do not belong together, or no prediction (too large, or without finite
        steady errors)
    BagError
        a path without a readable run
    """
    if not runs:
        raise InputError("no run: give at least one, or the path of its bag")
    if not 0.0 < level <= 0.5:
        raise InputError(f"level: {level:g}: expected a probability above 0, at most 0.5")
    if not 0.0 <= max_missed <= 1.0:
        raise InputError(f"max_missed: {max_missed:g}: expected a share of the deadlines, from 0 to 1")
    if len(runs) == 1:
        run = runs[0] if isinstance(runs[0], Run) else read_bag(runs[0])
        return compare_run(run, level=level, max_missed=max_missed)
    absent = [str(path) for path in runs if not isinstance(path, Run) and not Path(path).exists()]
    if absent:
        raise InputError(f"{', '.join(absent)}: not found: expected bags, {len(runs)} were given")
    named = (
        (f"run {place}", run) if isinstance(run, Run) else (str(run), read_bag(run))
        for place, run in enumerate(runs, start=1)
    )
    return compare_pooled(named, level=level, max_missed=max_missed)


def compare_pooled(
    runs: Iterable[tuple[str, Run]], *, level: float = 0.01, max_missed: float = MAX_MISSED
) -> Comparison:
    """Compare several runs of one experiment, by name and read one after the other, with its prediction."""
    total: Evidence | None = None
    prediction: Prediction | None = None
    trajectory: Run | None = None
    members: list[PooledRun] = []
    for name, run in runs:
        _require_another(members, name, run.record)
        experiment = run.record.experiment
        if prediction is None:
            reason = unpredictable(experiment)
            if reason:
                raise InputError(f"{name}: {reason}, so there is nothing to pool: compare one bag at a time")
            prediction, trajectory = predict_run(experiment, run.record.step_model), _without_data(run)
        prediction = prediction.for_run(experiment)
        member, evidence = _examine(name, run, prediction, level, max_missed)
        members.append(member)
        if evidence:
            total = total.merged(evidence) if total else evidence
    if prediction is None or trajectory is None:
        raise InputError("no bag: give at least one")
    trajectory = dataclasses.replace(trajectory, completeness=_sum([member.completeness for member in members]))
    pool = _pool(members) if total and total.decisive else Pool(tuple(members))
    if total is None:
        comparison = without_numbers(trajectory, level, prediction, 0)
    else:
        comparison = evaluate(trajectory, prediction, total, level, pool.p)
    return dataclasses.replace(comparison, pool=pool, max_missed=max_missed)


def _examine(
    name: str, run: Run, prediction: Prediction, level: float, max_missed: float
) -> tuple[PooledRun, Evidence | None]:
    """One run by itself, with its prediction; no evidence where too little of it arrived."""
    observation = Observation.of(run, prediction)
    if observation.steps < MIN_STEPS and not run.completeness.complete:
        missing = Estimate(predicted=prediction.emulated.system_error)
        return PooledRun(name, run.record, 0, run.completeness, missing, missing, "incomplete"), None
    evidence = Evidence.of(observation, level)
    alone = dataclasses.replace(evaluate(run, prediction, evidence, level), max_missed=max_missed)
    tested = alone.given.system_error if alone.given else alone.system_error
    member = PooledRun(name, run.record, evidence.steps, run.completeness, alone.system_error, tested, alone.verdict)
    return member, evidence


def _require_another(members: list[PooledRun], name: str, record: RunRecord) -> None:
    """InputError unless it is another run of the same experiment, independent of the others."""
    for other in members:
        if record.run == other.record.run:
            raise InputError(f"{name}: the same run as in {other.name} ({record.run}): give each run once")
        if record.experiment.run.seed == other.record.experiment.run.seed:
            raise InputError(
                f"{name}: run.seed: {record.experiment.run.seed} as in {other.name}, so both have the same random "
                "numbers: pool runs with different seeds"
            )
    if not members:
        return
    differs = first_difference(record.experiment, members[0].record.experiment)
    if differs:
        key, mine, others = differs
        raise InputError(
            f"{name}: {key}: {_shown(mine)}, but {_shown(others)} in {members[0].name}: pool runs of one experiment "
            "(seed and duration may differ), and compare others with `msg-analysis tabulate`"
        )


def _shown(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _without_data(run: Run) -> Run:
    """Only the record and the completeness."""
    logged: dict[str, Any] = dict.fromkeys(("agent_modes", "published", "lost", "used", "made"))
    return dataclasses.replace(run, states=run.states[:0], modes=run.modes[:0], **logged)


def _sum(counts: list[Completeness]) -> Completeness:
    refused: Counter[str] = Counter()
    for count in counts:
        refused.update(count.refused)
    names = "expected", "received", "missing", "duplicates", "out_of_order", "missing_modes"
    total = {name: sum(getattr(count, name) for count in counts) for name in names}
    return Completeness(**total, refused=dict(refused))


def _pool(members: list[PooledRun]) -> Pool:
    """Test whether measured - expected is the same in all runs: Cochran's Q."""
    tested = [member.tested for member in members]
    usable = [(error.z, error.standard_error) for error in tested if error.z is not None and error.standard_error]
    if len(usable) < 2:
        return Pool(tuple(members))
    z, errors = np.array(usable).T
    deviation, precision = z * errors, 1.0 / errors**2
    mean = float(precision @ deviation / precision.sum())
    chi2 = float(precision @ (deviation - mean) ** 2)
    return Pool(tuple(members), chi2, len(z) - 1, float(chi2_tail(chi2, len(z) - 1)))
