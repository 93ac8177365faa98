"""Documents of ``msg-analysis transient`` and ``msg-analysis facts``."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.model.step.sequential_law import build_run_model
from msg_analysis.theory.facts import check_facts
from msg_analysis.theory.graph_indices import error_bounds, graph_indices
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.settling import asymptotic_rates, settling_time
from msg_analysis.theory.system import jump_system as systems
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.transient import Transient, point_start, start_of, transient, unreduced_consensus
from msg_analysis.theory.two_topology import two_topology
from msg_analysis.types import FloatArray

TransientLaw = Literal["emulated", "continuous"]
Result = TypeVar("Result")


def parse_times(text: str) -> FloatArray:
    """Times (T,) from ``START:STOP:STEP`` (STOP included if met) or ``t1,t2,...``; InputError for anything else."""
    wanted = "expected START:STOP:STEP or t1,t2,..., ascending numbers >= 0: for example 0:10:0.5"
    try:
        parts = [float(part) for part in text.replace(":", ",").split(",")]
    except ValueError:
        raise InputError(f"--times {text}: {wanted}") from None
    if not np.isfinite(parts).all():
        raise InputError(f"--times {text}: {wanted}")
    if ":" not in text:
        return np.array(parts)
    if len(parts) != 3 or text.count(":") != 2 or parts[2] <= 0.0 or parts[1] < parts[0]:
        raise InputError(f"--times {text}: {wanted}")
    start, stop, step = parts
    count = int((stop - start) / step * (1.0 + 1e-12) + 1e-9) + 1
    return np.asarray(start + step * np.arange(count), dtype=float)


def describe_transient(
    experiment: Experiment,
    times: FloatArray,  # (T,) ascending [units of simulated time]
    *,
    law: TransientLaw = "emulated",
    unreduced: bool = False,
    moments: bool = False,
    fraction: float = 0.05,  # of the steady system error, for the settling time
) -> dict[str, Any]:
    """The document of ``msg-analysis transient``: moments, settling time, rates; arguments of ``solve_transient``.

    In discrete time its law is "discrete". With ``moments``, nu(t) and c(t) of every mode are in it, too.
    """
    solved = solve_transient(experiment, times, law=law, unreduced=unreduced)
    found = solved.course
    document: dict[str, Any] = {
        "law": "discrete" if experiment.time == "discrete" else law,
        "unreduced": unreduced,
        "agents": experiment.agents,
        "modes": [graph.name for graph in experiment.graph_list],
        "times": times.tolist(),
        "graph_law": found.laws.tolist(),
        "mean": found.mean.tolist(),
    }
    document |= dict(
        zip(_mean_squares(document), (found.system_error.tolist(), found.node_errors.tolist()), strict=True)
    )
    document |= _settling(experiment, solved.system, solved.steady, solved.unit or 1.0, fraction)
    if moments:
        document["mode_means"] = found.mode_means.tolist()
        document["mode_second_moments"] = found.mode_second_moments.tolist()
    return document


@dataclass(frozen=True, slots=True, eq=False)
class SolvedTransient:
    """Moments over time, and what they were computed with."""

    course: Transient
    system: JumpSystem  # reduced, also where the course is not
    steady: FloatArray  # (n, d, d) steady second moments of the system
    unit: float | None  # [units of simulated time] of a step; None in continuous time


def solve_transient(
    experiment: Experiment,
    times: FloatArray,  # (T,) ascending [units of simulated time]
    *,
    law: TransientLaw = "emulated",
    unreduced: bool = False,
) -> SolvedTransient:
    """Moments over time from the experiment's start; ``unreduced`` (consensus only): those of the states, which grow.

    InputError: times or a law that do not fit, too large, or no finite steady errors.
    """
    system, unit = _system(experiment, law)
    steady = MomentSolver(system).steady()
    if not unreduced:
        found = transient(system, start_of(experiment, system, steady), _steps(times, unit), steady)
        return SolvedTransient(found, system, steady, unit)
    if experiment.problem != "consensus":
        raise InputError("--unreduced: expected problem: consensus, since tracking reduces nothing: leave it out")
    if unit is None:
        whole = unreduced_consensus(experiment)
    else:
        whole = systems.emulated(build_run_model(experiment), "tracking")
    start = start_of(experiment, whole, system.lift @ steady @ system.lift.T)
    return SolvedTransient(transient(whole, start, _steps(times, unit)), system, steady, unit)


def _system(experiment: Experiment, law: TransientLaw) -> tuple[JumpSystem, float | None]:
    """The reduced system of a law, and the time of a step (None in continuous time)."""
    if law == "emulated":
        return systems.emulated(build_run_model(experiment), experiment.problem), experiment.step_length
    if experiment.time == "discrete":
        raise InputError("--law continuous: expected an experiment in continuous time: leave --law out")
    noise = experiment.noise
    if experiment.protocol:
        raise InputError(f"--law continuous: {experiment.protocol.info} has steps only: leave --law out")
    if noise.broadcast or noise.link or noise.loss or noise.delay:
        raise InputError(
            "--law continuous: noise.broadcast, link, loss and delay belong to steps, expected 0: leave --law out"
        )
    return systems.continuous(experiment), None


def _steps(times: FloatArray, unit: float | None) -> FloatArray:
    """Times in the unit of the system: steps in the emulated law, which must be whole."""
    if unit is None:
        return times
    steps = np.round(times / unit)
    wrong = np.abs(times - steps * unit) > 1e-9 * np.maximum(np.abs(times), unit)
    if wrong.any():
        raise InputError(
            f"--times: {times[wrong][0]:g} is no whole number of steps of {unit:g}, expected multiples: correct it, "
            "or use --law continuous"
        )
    return np.asarray(steps)


def _settling(
    experiment: Experiment, system: JumpSystem, steady: FloatArray, unit: float, fraction: float
) -> dict[str, Any]:
    """Keys ``steady_system_error``, ``settling`` [units of simulated time] and ``rates`` [1 / unit]."""
    error = float(np.trace(system.lifted(steady.sum(axis=0))))
    starts = {
        "from_start": start_of(experiment, system, steady),
        "from_zero": point_start(system, np.zeros(experiment.agents)),
    }
    rates = asymptotic_rates(system, steady)
    return {
        "steady_system_error": error,
        "settling": {
            "fraction": fraction,
            # Without noise there is no steady error to settle at.
            **{
                key: unit * settling_time(system, steady, start, fraction) if error > 0.0 else None
                for key, start in starts.items()
            },
        },
        "rates": {
            "mean": rates.mean / unit,
            "second_moment": None if rates.second_moment is None else rates.second_moment / unit,
            "graph": None if rates.graph is None else rates.graph / unit,
        },
    }


def describe_facts(experiment: Experiment) -> dict[str, Any]:
    """The document of ``msg-analysis facts``: lemmas, bounds, indices of the graphs, two graphs in closed form.

    None: a graph that is directed or disconnected; the closed form unless two graphs can each be held fixed; what the
    network is too large for, with the reason in ``notes``.
    """
    prediction = predict(experiment)
    laws = {"discrete" if experiment.time == "discrete" else "emulated": prediction.system}
    if prediction.continuous is not None:
        laws = {"continuous": systems.continuous(experiment)} | laws
    notes: list[str] = []

    def unless_refused(compute: Callable[[], Result]) -> Result | None:
        try:
            return compute()
        except InputError as error:
            notes.append(str(error))
            return None

    facts = unless_refused(lambda: [fact.to_json() for fact in check_facts(experiment)])
    forms = None
    if len(experiment.graph_list) == 2 and prediction.static is not None:
        forms = unless_refused(lambda: {law: two_topology(system).to_json() for law, system in laws.items()})
    indices = [graph_indices(graph) for graph in experiment.graph_list]
    return {
        "modes": [graph.name for graph in experiment.graph_list],
        "facts": facts,
        "bounds": error_bounds(prediction).to_json(),
        "graphs": [None if entry is None else entry.to_json() for entry in indices],
        "two_topology": forms,
        "notes": notes,
    }


def write_transient_csv(document: dict[str, Any], path: Path) -> None:
    """Write a row per time: the law of the graph, means and mean squares of the agents; whole or not at all."""
    system, nodes = _mean_squares(document)
    agents = range(1, document["agents"] + 1)
    header = ["time", *(f"probability of {name}" for name in document["modes"])]
    header += [*(f"mean of agent {i}" for i in agents), system.replace("_", " ")]
    header += [f"{nodes.removesuffix('s').replace('_', ' ')} of agent {i}" for i in agents]
    keys = ("times", "graph_law", "mean", system, nodes)
    rows = zip(*(document[key] for key in keys), strict=True)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows([time, *law, *mean, error, *errors] for time, law, mean, error, errors in rows)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error


def _mean_squares(document: dict[str, Any]) -> tuple[str, str]:
    kind = "second_moment" if document["unreduced"] else "error"
    return f"system_{kind}", f"node_{kind}s"
