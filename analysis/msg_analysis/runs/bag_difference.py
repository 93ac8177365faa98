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

"""What differs between the runs of two bags: experiments, versions, states, graphs, verdicts, measured errors."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from msg_analysis.bags.reader import read_bag
from msg_analysis.common.files import RESULT_FILE
from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.errors import InputError
from msg_analysis.inference.verdict.compare import compare
from msg_analysis.inference.verdict.law_identity import flat
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.documents.comparison_words import agent_errors
from msg_analysis.runs.pairs import differing, measured
from msg_analysis.runs.saved_result import read_document, result_row, tested_error
from msg_analysis.runs.state_difference import graph_difference, state_difference

_NUMBERS = ("measured", "standard_error", "predicted")


def bag_difference(a: Path, b: Path) -> dict[str, Any]:
    """The document of ``msg-analysis diff`` of two bags; keys in docs/commands.md. Differences are B - A.

    BagError or InputError: a bag or its run record cannot be read. Verdict and errors come from the saved result of
    the run, if there is one, else they are computed.
    """
    runs = [read_bag(path) for path in (a, b)]
    results = [_result(path, run) for path, run in zip((a, b), runs, strict=True)]
    one, other = (run.record for run in runs)
    sides = [_side(*each) for each in zip((a, b), runs, results, strict=True)]
    return {
        "kind": "bags",
        "a": sides[0],
        "b": sides[1],
        "keys": differing(*(flat(record.experiment.to_document()) for record in (one, other))),
        "versions": differing(one.versions, other.versions),
        "states": state_difference(*runs),
        "graphs": graph_difference(*runs),
        "errors": {
            "independent": one.experiment.run.seed != other.experiment.run.seed,
            "system": measured(*(side["system_error"] for side in sides)),
            "agents": _agents(*(_agent_errors(result) for result in results)),
        },
    }


def _side(path: Path, run: Trajectory, result: dict[str, Any]) -> dict[str, Any]:
    record, completeness = run.record, run.completeness
    tested = tested_error(result, path / RESULT_FILE)
    given = tested is not None and result["system_error"]["standard_error"] is None
    errors = tested or {key: (result.get("system_error") or {}).get(key) for key in _NUMBERS}
    return {
        "bag": str(path),
        "run": str(record.run),
        "experiment": record.experiment.name,
        "seed": record.experiment.run.seed,
        "agents": record.experiment.agents,
        "names": record.experiment.names,
        "steps": record.experiment.steps,
        "simulated_time": record.experiment.run.duration,
        "complete": completeness.complete,
        "completeness": asdict(completeness),
        "prefix": run.prefix,
        "verdict": result.get("verdict"),
        "unpredicted": result.get("unpredicted"),
        "system_error": _with_interval(errors) | {"given_path": given},
    }


def _result(path: Path, run: Trajectory) -> dict[str, Any]:
    """The comparison of a run: as saved beside its bag, or made now; only the reason where there is none."""
    folder = path if path.is_dir() else path.parent
    try:
        document = read_document(folder)
        result_row(folder, document)
        if document.get("run") == str(run.record.run) and "node_errors" in document:
            return document
    except InputError:  # none, or not one
        pass
    try:
        return compare(run).to_json()
    except InputError as error:
        return {"verdict": None, "unpredicted": str(error)}


def _agent_errors(result: dict[str, Any]) -> list[dict[str, Any]]:
    if "node_errors" not in result:
        return []
    return [_with_interval(node) for node in agent_errors(result)[0]]


def _agents(a: list[dict[str, Any]], b: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Side by side, where both runs have as many agents; empty otherwise."""
    return [measured(*pair) for pair in zip(a, b, strict=True)] if len(a) == len(b) else []


def _with_interval(error: dict[str, Any]) -> dict[str, Any]:
    """Measured, standard error and prediction, with the 95 % interval."""
    value, deviation = error.get("measured"), error.get("standard_error")
    numbers = {key: error.get(key) for key in _NUMBERS}
    if value is None or deviation is None:
        return numbers | {"low": None, "high": None}
    half = HALF_WIDTH_95 * deviation
    return numbers | {"low": value - half, "high": value + half}
