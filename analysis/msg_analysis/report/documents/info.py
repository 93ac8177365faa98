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

"""Experiments and bags as documents, for ``msg-analysis info``."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msg_analysis.errors import InputError
from msg_analysis.model.experiment import memory, validation
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.network.graphs import Graph
from msg_analysis.theory.graph_indices import algebraic_connectivity
from msg_analysis.theory.prediction import predict

if TYPE_CHECKING:
    from msg_analysis.bags.format.inventory import FileInventory, Inventory
    from msg_analysis.bags.salvage import SalvageReport


def describe_experiment(experiment: ValidExperiment) -> dict[str, Any]:
    """The document of ``msg-analysis info EXPERIMENT --json``; the experiment need not be one that can be run.

    None: infinite or not computable; a stability limit with a delay or a protocol is not known. Memory in bytes.
    """
    document = experiment.to_document()
    chain = experiment.chain
    states, matrices = memory.memory_needed(
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
        "names": experiment.names,
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
                experiment.graph_list, chain.stationary, chain.holding_times, limits, strict=True
            )
        ],
        "stability_limit": min((limit for limit in limits if limit is not None), default=None),
        "predicted_system_error": _predicted_system_error(experiment),
        "memory": {"states": states, "matrices": matrices},
        "unavailable": experiment.unavailable(),
    }


def describe_bag(path: Path) -> dict[str, Any]:
    """The document of ``msg-analysis info BAG --json``, for a whole or a torn bag; keys in docs/commands.md.

    InputError if no file of it can be read; a bag that is not a run has a ``problem``, and None for the run's keys.
    """
    from msg_analysis.bags.format.inventory import Inventory  # imported here: experiments do not need it
    from msg_analysis.bags.format.metadata import total_channels
    from msg_analysis.bags.writer import recording_pid

    inventory = Inventory()
    run = _describe_run(path, inventory)
    entries = {entry.file.path: entry for entry in inventory.files}
    others = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else []
    files = [*entries, *(file for file in others if file not in entries)]
    return {
        "bag": str(path),
        "recording": recording_pid(path),
        **run,
        "topics": [
            {"name": topic.topic, "type": topic.type_name, "messages": topic.messages}
            for topic in total_channels([entry.count for entry in inventory.files]).values()
        ],
        "files": [
            {"name": file.name, "size": file.stat().st_size}
            | (_describe_file(entries[file]) if file in entries else {})
            for file in files
        ],
    }


def _describe_run(path: Path, inventory: Inventory) -> dict[str, Any]:
    from msg_analysis.bags.reader import read_bag

    try:
        trajectory = read_bag(path, inventory)
    except InputError as error:
        if all(entry.problem for entry in inventory.files):
            raise
        keys = (
            "run",
            "experiment",
            "seed",
            "agents",
            "names",
            "replicas",
            "steps",
            "simulated_time",
            "completeness",
            "prefix",
        )
        return {"problem": str(error), **dict.fromkeys(keys), "protocol": None, "versions": {}}
    record = trajectory.record
    run = record.experiment.run
    completeness = trajectory.completeness
    return {
        "problem": None,
        "run": str(record.run),
        "experiment": record.experiment.name,
        "seed": run.seed,
        "agents": record.experiment.agents,
        "names": record.experiment.names,
        "replicas": run.replicas,
        "steps": record.experiment.steps,
        "simulated_time": run.duration,
        "completeness": dataclasses.asdict(completeness)
        | {"complete": completeness.complete, "stretch": trajectory.stretch},
        "prefix": trajectory.prefix,
        "protocol": _protocol(record.experiment),
        "versions": record.versions,
    }


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
    """The document of ``msg-analysis salvage --json``: the report's fields, and the run read from the new bag."""
    from msg_analysis.bags.format.inventory import Inventory

    return {"bag": str(out), **dataclasses.asdict(report), **_describe_run(out, Inventory())}


def _protocol(experiment: ValidExperiment) -> dict[str, Any] | None:
    """The protocol of the agents; None for the built-in law."""
    protocol = experiment.protocol
    if protocol is None:
        return None
    parameters = experiment.to_document()["protocol"]
    return protocol.info.to_json() | {
        "parameters": {key: value for key, value in parameters.items() if key != "name"},
        "absent": protocol.absent,
    }


def _stability_limit(experiment: ValidExperiment, graph: Graph) -> float | None:
    if experiment.time == "discrete" or experiment.noise.delay or experiment.protocol:
        return None
    limit = validation.stability_limit(graph, experiment.leader_gains)
    return limit if math.isfinite(limit) else None


def _predicted_system_error(experiment: ValidExperiment) -> float | None:
    try:
        experiment.require_available("predict")
        return predict(experiment).emulated.system_error
    except InputError:  # experiments without a prediction are described, too
        return None
