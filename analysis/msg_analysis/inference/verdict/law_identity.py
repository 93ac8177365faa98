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

"""Whether runs are of one experiment: which keys of an experiment file define its law."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from msg_analysis.model.experiment.experiment import ValidExperiment

# Keys of an experiment that do not change its law
MAY_DIFFER = {"name", "names", "run.seed", "run.duration", "run.processes", "run.speed"}


def law_keys(experiment: ValidExperiment) -> dict[str, Any]:
    """Every key (nested ones with dots) that defines the law of a run, and its value."""
    found = flat(experiment.to_document())
    # The order of the graphs is that of the modes.
    found["graphs"] = [graph.name for graph in experiment.graph_list]
    if experiment.protocol:
        found["protocol.version"] = experiment.protocol.info.version
    return {key: value for key, value in found.items() if key not in MAY_DIFFER}


def law_identity(experiment: ValidExperiment) -> str:
    """A text of 16 hexadecimal digits, the same for runs of the same law."""
    text = json.dumps(law_keys(experiment), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def first_difference(one: ValidExperiment, other: ValidExperiment) -> tuple[str, Any, Any] | None:
    """Key and both values of the first difference, by name; None where the law is the same."""
    a, b = law_keys(one), law_keys(other)
    for key in sorted(a.keys() | b.keys()):
        if a.get(key) != b.get(key):
            return key, a.get(key), b.get(key)
    return None


def flat(document: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every key of nested mappings, joined by dots, and its value."""
    found: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
