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

"""A saved result: what `msg-analysis compare --json` or `msg-agents run` wrote, checked, as a row of a table."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msg_analysis.common.bounded_input import read_text
from msg_analysis.common.files import RESULT_FILE
from msg_analysis.common.text.agent_names import agent_name, with_names
from msg_analysis.errors import InputError

_WANTED = "expected what `msg-analysis compare --json` or `msg-agents run` wrote"


@dataclass(frozen=True, slots=True)
class Result:
    """A row: one saved comparison; None where it has no such number."""

    file: str
    experiment: str
    seeds: str  # of all runs: "1 2"
    bags: int  # number of runs
    leaders: str  # names, or numbers from 1: "3" or "1 4"; empty without
    verdict: str
    simulated_time: float  # of all runs [units of simulated time]
    measured: float | None  # system error, like the next five
    standard_error: float | None
    low: float | None  # to high: the 95 % interval
    high: float | None
    predicted: float | None
    z: float | None
    least_p: float | None  # least adjusted p of the tests
    blame: str  # causes, separated by "; "; empty where nothing is wrong
    identity: str | None  # equal for runs of the same law


def read_result(path: Path) -> Result:
    """Read a saved result, from a file or the directory of a run; InputError if it is not there or not a result."""
    return result_row(path, read_document(path))


def read_document(path: Path) -> dict[str, Any]:
    """The document of a saved result, which only ``result_row`` checks; arguments and errors as of ``read_result``."""
    file = _file(path)
    try:
        document = json.loads(read_text(file))
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}: {_WANTED}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not JSON ({error}): {_WANTED}") from error
    if not isinstance(document, dict):
        raise InputError(f"{file}: not a JSON object: {_WANTED}")
    return document


def _file(path: Path) -> Path:
    return path / RESULT_FILE if path.is_dir() else path


def result_row(path: Path, document: dict[str, Any]) -> Result:
    """The row of a document of ``read_document``; InputError if it is not a result."""
    file = _file(path)
    total = _part(document, "system_error", dict, file)
    interval = total.get("interval")
    if not isinstance(interval, list) or len(interval) != 2:
        raise InputError(f"{file}: system_error.interval: {interval!r}: {_WANTED}")
    bags = _parts(document, "bags", file)
    seeds = [run.get("seed") for run in bags or [document]]
    tests = [_number(test, "p_adjusted", file) for test in _parts(document, "tests", file)]
    given = document.get("names")
    names = list(map(str, given)) if isinstance(given, list) else None
    blame = [with_names(str(cause.get("words")), names) for cause in _parts(document, "blame", file)]
    leaders = document.get("leaders")
    identity = document.get("experiment_identity")
    return Result(
        file=str(path),
        experiment=_part(document, "experiment", str, file),
        seeds=" ".join(str(seed) for seed in seeds if seed is not None),
        bags=len(bags) or 1,
        leaders=" ".join(_leader(leader, names) for leader in leaders) if isinstance(leaders, list) else "",
        verdict=_part(document, "verdict", str, file),
        simulated_time=_number(document, "simulated_time", file) or 0.0,
        measured=_number(total, "measured", file),
        standard_error=_number(total, "standard_error", file),
        low=_number({"interval": interval[0]}, "interval", file),
        high=_number({"interval": interval[1]}, "interval", file),
        predicted=_number(total, "predicted", file),
        z=_number(total, "z", file),
        least_p=min((p for p in tests if p is not None), default=None),
        blame="; ".join(blame),
        identity=identity if isinstance(identity, str) else None,
    )


def _part(document: dict[str, Any], key: str, kind: type, file: Path) -> Any:
    value = document.get(key)
    if not isinstance(value, kind):
        raise InputError(f"{file}: {key}: {value!r}: expected that of a result of `msg-analysis compare --json`")
    return value


def _parts(document: dict[str, Any], key: str, file: Path) -> list[dict[str, Any]]:
    """The objects of a list; none where it is null or not there."""
    value = document.get(key) or []
    if not isinstance(value, list) or not all(isinstance(part, dict) for part in value):
        raise InputError(f"{file}: {key}: expected a list of objects, as `msg-analysis compare --json` writes it")
    return value


def _number(document: Any, key: str, file: Path) -> float | None:
    value = document.get(key) if isinstance(document, dict) else document
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{file}: {key}: {value!r}: expected a number")
    return float(value)


def tested_error(document: dict[str, Any], file: Path) -> dict[str, float | None] | None:
    """The system error of a document with the standard error that tests use; None where it has none.

    In runs that are too short for one over all paths of the graphs, that is the one given the path; then the measured
    error is corrected for the path. Keys: ``measured``, ``standard_error``, ``predicted``.
    """
    given = document.get("given_path")
    for part in (document, given if isinstance(given, dict) else {}):
        error = part.get("system_error")
        if isinstance(error, dict) and error.get("standard_error") is not None:
            return {key: _number(error, key, file) for key in ("measured", "standard_error", "predicted")}
    return None


def _leader(leader: object, names: Sequence[str] | None) -> str:
    return agent_name(leader, names) if isinstance(leader, int) else str(leader)
