# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Results as JSON documents."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from msg_analysis.bags.files import FileInventory, total_channels
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import recording_pid
from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import write_whole
from msg_analysis.common.resources import few_blas_threads
from msg_analysis.common.text import agent_name
from msg_analysis.errors import InputError
from msg_analysis.experiment import limits, validation
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.links import expanded, given_graphs
from msg_analysis.experiment.markov_chain import SojournSchedule
from msg_analysis.inference.autocovariance import (
    LoggedAutocovariance,
    LoggedDensity,
    logged_autocovariance,
    why_not_tested,
)
from msg_analysis.inference.log_spectrum import log_spectrum
from msg_analysis.inference.observation import Observation
from msg_analysis.model.log import Log
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.facts import check_facts
from msg_analysis.theory.first_steps import simplification
from msg_analysis.theory.graph_indices import algebraic_connectivity, error_bounds, graph_indices, two_topology
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.sampling import sampled_prediction
from msg_analysis.theory.settling import asymptotic_rates, settling_time
from msg_analysis.theory.spectrum import Spectrum, spectrum
from msg_analysis.theory.transient import TransientLaw, point_start, solve_transient, start_of

if TYPE_CHECKING:
    from msg_analysis.bags.salvage import SalvageReport


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredSpectrum:
    """A predicted spectrum, and what a log says of it."""

    predicted: Spectrum
    level: float | None = None
    log: LoggedAutocovariance | None = None
    density: LoggedDensity | None = None
    note: str | None = None  # why the log is not tested, or not all of it
    complete: bool = True

    @property
    def disagrees(self) -> bool:
        """Whether the test rejects."""
        return self.log is not None and self.log.p is not None and self.level is not None and self.log.p < self.level

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return self.predicted.to_json() | {
            "level": self.level,
            "agrees": None if self.log is None or self.log.p is None else not self.disagrees,
            "log": self.log and self.log.to_json(),
            "log_density": self.density
            and {"frequencies": self.density.frequencies.tolist(), "system": self.density.system.tolist()},
            "note": self.note,
        }


def predicted_spectrum(experiment: Experiment) -> MeasuredSpectrum:
    """Of an experiment; errors as of ``spectrum`` and ``predict``."""
    experiment.require_available("steady")
    return MeasuredSpectrum(spectrum(predict(experiment)))


def measure_spectrum(bag: Path, level: float) -> MeasuredSpectrum:
    """Of the run in a bag, of a torn one of what is before the first gap."""
    trajectory = read_bag(bag)
    experiment = trajectory.record.experiment
    given_graphs(experiment).require_available("steady")
    prediction = predict(experiment, trajectory.record.step_model)
    observation = Observation.of(trajectory, prediction)
    reason = why_not_tested(observation)
    density = LoggedDensity.of(observation) if observation.steps >= 8 else None
    log = logged_autocovariance(observation) if reason is None else None
    note = None
    if reason is not None:
        note = f"the log is not tested: {reason}"
    elif log is None:
        note = "the log is not tested: lost messages make too many kinds of steps"
    elif log.steps < observation.steps:
        note = f"the first {log.steps} of {observation.steps} steps are tested"
    return MeasuredSpectrum(spectrum(prediction), level, log, density, note, trajectory.completeness.complete)


def measure_log_spectrum(log: Log, level: float) -> MeasuredSpectrum:
    """Of a log of any origin."""
    predicted, measured, density, note = log_spectrum(log)
    return MeasuredSpectrum(predicted, level, measured, density, note)


Result = TypeVar("Result")


def describe_transient(
    experiment: Experiment,
    times: FloatArray,  # (T,) ascending [units of simulated time]
    *,
    law: TransientLaw = "emulated",
    unreduced: bool = False,
    moments: bool = False,
    fraction: float = 0.05,  # of the steady system error, for the settling time
) -> dict[str, Any]:
    """The document of ``transient``, with the arguments of ``solve_transient``; ``moments``: of every mode, too."""
    experiment = expanded(experiment)
    solved = solve_transient(experiment, times, law=law, unreduced=unreduced)
    found = solved.course
    document: dict[str, Any] = {
        "law": "discrete" if experiment.time == "discrete" else law,
        "unreduced": unreduced,
        "agents": experiment.agents,
        "names": experiment.names,
        "modes": [graph.name for graph in experiment.graph_list],
        "times": times.tolist(),
        "graph_law": found.laws.tolist(),
        "mean": found.mean.tolist(),
    }
    system, nodes = _mean_squares(document)
    document |= {system: found.system_error.tolist(), nodes: found.node_errors.tolist()}
    if experiment.schedule:
        document |= {"steady_system_error": None, "settling": None, "rates": None}
    else:
        document |= _settling(experiment, solved.system, solved.steady, solved.unit or 1.0, fraction)
    note = simplification(solved.system)
    document["notes"] = [note] if note else []
    if moments:
        document["mode_means"] = found.mode_means.tolist()
        document["mode_second_moments"] = found.mode_second_moments.tolist()
    return document


def _settling(
    experiment: Experiment, system: JumpSystem, steady: FloatArray, unit: float, fraction: float
) -> dict[str, Any]:
    """Keys ``steady_system_error``, ``settling`` [units of simulated time] and ``rates`` [1 / unit]."""
    error = float(np.trace(system.lifted(steady.sum(axis=0))))
    starts = {
        "from_start": start_of(experiment, system, system.lifted(steady)),
        "from_zero": point_start(system, np.zeros(experiment.agents)),
    }
    rates = asymptotic_rates(system)
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
        "rates": {key: None if rate is None else rate / unit for key, rate in dataclasses.asdict(rates).items()},
    }


def describe_facts(experiment: Experiment) -> dict[str, Any]:
    """The document of ``facts``; None: of a graph, of another number of graphs, or too large (``notes``)."""
    experiment = expanded(experiment)
    prediction = predict(experiment)
    laws = {"discrete" if experiment.time == "discrete" else "emulated": prediction.system}
    if prediction.continuous_moments is not None:
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
    if len(experiment.graph_list) == 2 and prediction.static_moments is not None:
        forms = unless_refused(lambda: {law: two_topology(system).to_json() for law, system in laws.items()})
    indices = [graph_indices(graph) for graph in experiment.graph_list]
    return {
        "names": experiment.names,
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
    agents = [agent_name(i, document["names"]) for i in range(1, document["agents"] + 1)]
    header = ["time", *(f"probability of {name}" for name in document["modes"])]
    header += [*(f"mean of agent {i}" for i in agents), system.replace("_", " ")]
    header += [f"{nodes.removesuffix('s').replace('_', ' ')} of agent {i}" for i in agents]
    keys = ("times", "graph_law", "mean", system, nodes)
    rows = zip(*(document[key] for key in keys), strict=True)
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows([time, *law, *mean, error, *errors] for time, law, mean, error, errors in rows)
    try:
        write_whole(path, text.getvalue().encode())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error


def _mean_squares(document: dict[str, Any]) -> tuple[str, str]:
    kind = "second_moment" if document["unreduced"] else "error"
    return f"system_{kind}", f"node_{kind}s"


@few_blas_threads
def describe_experiment(experiment: Experiment) -> dict[str, Any]:
    """The document of ``info EXPERIMENT``, also of one that cannot be run; None: infinite or not known."""
    if limits.needs_sampling(experiment):
        experiment.require_available()
    document = experiment.to_document()
    switching, schedule = experiment.switching_law, experiment.schedule
    states, matrices = limits.memory_needed(
        experiment.agents, switching.modes, experiment.steps, experiment.width, experiment.noise.delay, experiment.truth
    )
    links, graphs = experiment.links, experiment.written_graphs
    shares, holding_times = switching.stationary.tolist(), experiment.holding_times
    law: dict[str, Any] = {}
    chain = None if schedule else experiment.chain
    if experiment.noise.leaves_out_steps:
        law = {"activation": experiment.noise.activation}
    elif links:
        law = {"links": links.to_json()}
    elif isinstance(switching, SojournSchedule):
        law = {"sojourn": document["switching"]["sojourn"]}
        chain, unit = switching.law.chain, experiment.step_length if experiment.time == "discrete" else 1.0
        shares = chain.stationary.tolist()
        holding_times = [None if held is None else unit * held for held in chain.holding_times]
    elif schedule:
        law = {"schedule": schedule.to_json()}
    if links:
        shares, holding_times = [None], [None]
    highest_dt: list[float | None] = [None] * len(graphs)
    if experiment.time != "discrete" and not experiment.noise.delay and not experiment.protocol:
        found = (validation.stability_limit(graph, experiment.leader_gains) for graph in graphs)
        highest_dt = [limit if math.isfinite(limit) else None for limit in found]
    prediction = _method(experiment)
    return {
        "name": experiment.name,
        "problem": experiment.problem,
        "time": experiment.time,
        "agents": experiment.agents,
        "names": experiment.names,
        "leaders": document.get("leaders"),
        "protocol": _protocol(experiment),
        "noise": document["noise"],
        "run": document["run"] | {"steps": experiment.steps},
        "switching": {
            "matrix": chain and chain.matrix.tolist(),
            "initial": experiment.switching.initial,
            **law,
        },
        "graphs": [
            {
                "name": graph.name,
                "edges": graph.edges if graph.symmetric else None,
                "arcs": None if graph.symmetric else graph.arcs,
                "algebraic_connectivity": algebraic_connectivity(graph),
                "stationary": share,
                "mean_holding_time": holding_time,
                "stability_limit": limit,
            }
            for graph, share, holding_time, limit in zip(graphs, shares, holding_times, highest_dt, strict=True)
        ],
        "stability_limit": min((limit for limit in highest_dt if limit is not None), default=None),
        "predicted_system_error": prediction.pop("system_error"),
        "prediction": prediction,
        "memory": {"states": states, "matrices": matrices},
        "unavailable": limits.unavailable(experiment),
        "notes": list(experiment.notes),
    }


SHORT, ONE_PERCENT = 2.0, 0.01  # s for which errors are sampled to say how long it takes to know them so well


def _method(experiment: Experiment) -> dict[str, Any]:
    """How the steady errors are known: "exact", "sampled", or "measured" in runs only; why; and the system error."""
    method, why = limits.prediction_method(experiment)
    found: dict[str, Any] = {"method": method, "why": why, "seconds": None, "system_error": None}
    if method == "sampled":
        with suppress(InputError):  # not known so fast
            sampled = sampled_prediction(experiment, precision=ONE_PERCENT, within=SHORT)
            width = (sampled.interval[1] - sampled.interval[0]) / 2.0 / (ONE_PERCENT * sampled.system_error)
            found |= {"system_error": sampled.system_error, "seconds": sampled.seconds * width**2}
    elif method == "exact":
        try:
            found["system_error"] = predict(experiment).emulated.system_error
        except InputError as error:
            found |= {"method": "measured", "why": str(error)}
    return found


def describe_bag(path: Path) -> dict[str, Any]:
    """The document of ``info BAG``, also of a torn one; InputError if no file of it can be read."""
    inventory: list[FileInventory] = []
    run = _describe_run(path, inventory)
    entries = {entry.file.path: entry for entry in inventory}
    others = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else []
    files = [*entries, *(file for file in others if file not in entries)]
    return {
        "bag": str(path),
        "recording": recording_pid(path),
        **run,
        "topics": [
            {"name": topic.topic, "type": topic.type_name, "messages": topic.messages}
            for topic in total_channels([entry.count for entry in inventory]).values()
        ],
        "files": [
            {"name": file.name, "size": file.stat().st_size}
            | (_describe_file(entries[file]) if file in entries else {})
            for file in files
        ],
    }


_OF_RUN = (
    *("run", "experiment", "seed", "agents", "names", "replicas", "steps", "simulated_time"),
    *("completeness", "prefix", "protocol"),
)


def _describe_run(path: Path, inventory: list[FileInventory]) -> dict[str, Any]:
    try:
        trajectory = read_bag(path, inventory)
    except InputError as error:
        if all(entry.problem for entry in inventory):
            raise
        return {"problem": str(error), **dict.fromkeys(_OF_RUN), "versions": {}}
    record, count = trajectory.record, trajectory.completeness
    experiment = record.experiment
    values = (
        *(str(record.run), experiment.name, experiment.run.seed, experiment.agents, experiment.names),
        *(experiment.run.replicas, experiment.steps, experiment.run.duration),
        dataclasses.asdict(count) | {"complete": count.complete, "stretch": trajectory.stretch},
        *(trajectory.prefix, _protocol(experiment)),
    )
    return {"problem": None, **dict(zip(_OF_RUN, values, strict=True)), "versions": record.versions}


def _describe_file(entry: FileInventory) -> dict[str, Any]:
    count, some = entry.count, entry.count.messages > 0
    return {
        "messages": count.messages,
        "start": count.start if some else None,
        "end": count.end if some else None,
        "compression": entry.compression,
        "torn": entry.file.torn,
        "damaged_chunks": entry.file.damaged_chunks,
        "lost_messages": entry.lost_messages,
        "problem": entry.problem,
    }


def describe_salvage(out: Path, report: SalvageReport) -> dict[str, Any]:
    """The document of ``salvage``: the report's fields, and the run read from the new bag."""
    return {"bag": str(out), **dataclasses.asdict(report), **_describe_run(out, [])}


def _protocol(experiment: Experiment) -> dict[str, Any] | None:
    protocol = experiment.protocol
    if protocol is None:  # the built-in law
        return None
    parameters = experiment.to_document()["protocol"]
    return protocol.info.to_json() | {
        "parameters": {key: value for key, value in parameters.items() if key != "name"},
        "absent": protocol.absent,
    }
