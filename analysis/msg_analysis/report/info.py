"""Experiments and bags explained back, as documents for ``msg-analysis info``."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.model import validation
from msg_analysis.model.experiment import Experiment
from msg_analysis.model.graphs import Graph
from msg_analysis.theory.prediction import predict


def describe_experiment(experiment: Experiment) -> dict[str, Any]:
    """What an experiment says, with what follows from it.

    Returns
    -------
    ``name``, ``problem``, ``time``, ``agents``, ``leaders``, ``protocol`` (``name``, ``package``, ``version``,
    ``linear``, ``states``, ``hidden``, ``parameters``, ``absent``), ``noise``, ``run`` (with ``steps``),
    ``switching`` (``matrix``, ``initial``), ``graphs`` (each ``name``, ``edges`` or ``arcs``,
    ``algebraic_connectivity``, ``stationary``, ``mean_holding_time``, ``stability_limit``),
    ``stability_limit``, ``predicted_system_error``, ``memory`` [bytes], ``unavailable``. None stands for what
    is infinite or cannot be computed, or, for the stability limits, is not known (with a delay or a protocol).
    """
    document = experiment.to_document()
    chain = experiment.chain
    states, matrices = validation.memory_needed(
        experiment.agents,
        chain.modes,
        experiment.steps,
        experiment.width,
        experiment.noise.delay,
        experiment.truth,
    )
    limits = [_stability_limit(experiment, graph) for graph in experiment.graph_list]
    return {
        "name": experiment.name,
        "problem": experiment.problem,
        "time": experiment.time,
        "agents": experiment.agents,
        "leaders": document.get("leaders"),
        "protocol": _protocol(experiment),
        "noise": document["noise"],
        "run": document["run"] | {"steps": experiment.steps},
        "switching": {"matrix": chain.matrix.tolist(), "initial": experiment.switching.initial},
        "graphs": [
            {
                "name": graph.name,
                "edges": graph.edges if graph.symmetric else None,
                "arcs": None if graph.symmetric else graph.arcs,
                "algebraic_connectivity": algebraic_connectivity(graph),
                "stationary": float(share),
                "mean_holding_time": holding_time,
                "stability_limit": limit,
            }
            for graph, share, holding_time, limit in zip(
                experiment.graph_list, chain.stationary, _holding_times(experiment), limits, strict=True
            )
        ],
        "stability_limit": min((limit for limit in limits if limit is not None), default=None),
        "predicted_system_error": _predicted_system_error(experiment),
        "memory": {"states": states, "matrices": matrices},
        "unavailable": experiment.unavailable(),
    }


def describe_bag(path: Path) -> dict[str, Any]:
    """What a bag holds.

    Parameters
    ----------
    path : bag directory or MCAP file

    Returns
    -------
    ``bag``, ``run``, ``experiment``, ``seed``, ``agents``, ``replicas``, ``steps``, ``simulated_time``,
    ``completeness``, ``files`` (each ``name``, ``size`` [bytes]), ``protocol`` (as of an experiment), ``versions``

    Raises
    ------
    InputError : not a bag of a run
    """
    from msg_analysis.bags.reader import read_bag  # here: an experiment does not need it

    trajectory = read_bag(path)
    record = trajectory.record
    run = record.experiment.run
    completeness = trajectory.completeness
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    return {
        "bag": str(path),
        "run": str(record.run),
        "experiment": record.experiment.name,
        "seed": run.seed,
        "agents": record.experiment.agents,
        "replicas": run.replicas,
        "steps": record.experiment.steps,
        "simulated_time": run.duration,
        "completeness": dataclasses.asdict(completeness) | {"complete": completeness.complete},
        "files": [{"name": file.name, "size": file.stat().st_size} for file in files],
        "protocol": _protocol(record.experiment),
        "versions": record.versions,
    }


def _protocol(experiment: Experiment) -> dict[str, Any] | None:
    """What the agents do instead of the built-in law; None for that."""
    protocol = experiment.protocol
    if protocol is None:
        return None
    parameters = experiment.to_document()["protocol"]
    return protocol.info.to_json() | {
        "parameters": {key: value for key, value in parameters.items() if key != "name"},
        "absent": protocol.absent,
    }


def algebraic_connectivity(graph: Graph) -> float:
    """Second smallest real part of the Laplacian's eigenvalues: how fast agreement comes with this graph."""
    laplacian = graph.laplacian
    values = np.linalg.eigvalsh(laplacian) if graph.symmetric else np.linalg.eigvals(laplacian)
    return max(float(np.sort(values.real)[1]), 0.0)


def _stability_limit(experiment: Experiment, graph: Graph) -> float | None:
    if experiment.time == "discrete" or experiment.noise.delay or experiment.protocol:
        return None
    limit = validation.stability_limit(graph, experiment.leader_gains)
    return limit if math.isfinite(limit) else None


def _holding_times(experiment: Experiment) -> list[float | None]:
    """Mean time in each graph at a stretch; None where it is never left."""
    matrix = experiment.chain.matrix
    leaving = (matrix - np.diag(np.diag(matrix))).sum(axis=1)
    return [1.0 / rate if rate > 0 else None for rate in leaving.tolist()]


def _predicted_system_error(experiment: Experiment) -> float | None:
    try:
        experiment.require_available("predict")
        return predict(experiment).emulated.system_error
    except InputError:  # what cannot be predicted can be explained all the same
        return None
