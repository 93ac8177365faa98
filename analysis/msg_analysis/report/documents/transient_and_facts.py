# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Documents of ``msg-analysis transient`` and ``msg-analysis facts``."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.theory.decay_rates import asymptotic_rates
from msg_analysis.theory.facts import check_facts
from msg_analysis.theory.graph_indices import error_bounds, graph_indices
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.settling import settling_time
from msg_analysis.theory.system import jump_system as systems
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.transient import TransientLaw, point_start, solve_transient, start_of
from msg_analysis.theory.two_topology import two_topology
from msg_analysis.types import FloatArray

Result = TypeVar("Result")


def describe_transient(
    experiment: ValidExperiment,
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
        "names": experiment.names,
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


def _settling(
    experiment: ValidExperiment, system: JumpSystem, steady: FloatArray, unit: float, fraction: float
) -> dict[str, Any]:
    """Keys ``steady_system_error``, ``settling`` [units of simulated time] and ``rates`` [1 / unit]."""
    error = float(np.trace(system.lifted(steady.sum(axis=0))))
    starts = {
        "from_start": start_of(experiment, system, steady),
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


def describe_facts(experiment: ValidExperiment) -> dict[str, Any]:
    """The document of ``msg-analysis facts``: lemmas, bounds, indices of the graphs, two graphs in closed form.

    None: a graph that is directed or disconnected; the closed form unless two graphs can each be held fixed; what the
    network is too large for, with the reason in ``notes``.
    """
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
