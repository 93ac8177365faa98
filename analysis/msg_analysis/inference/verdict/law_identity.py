"""Whether runs are of one experiment: what of an experiment file makes its law, and what does not."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from msg_analysis.model.experiment.experiment import Experiment

MAY_DIFFER = {"name", "run.seed", "run.duration", "run.processes", "run.speed"}
"""Keys of an experiment that change nothing about its law."""


def law_keys(experiment: Experiment) -> dict[str, Any]:
    """Every key, with dots, that makes the law of a run, and its value.

    Parameters
    ----------
    experiment
        checked
    """
    found = _flat(experiment.to_document())
    # The order of the graphs is that of the modes.
    found["graphs"] = [graph.name for graph in experiment.graph_list]
    if experiment.protocol:
        found["protocol.version"] = experiment.protocol.info.version
    return {key: value for key, value in found.items() if key not in MAY_DIFFER}


def law_identity(experiment: Experiment) -> str:
    """A short text that is the same for runs of the same law.

    Parameters
    ----------
    experiment
        checked
    """
    text = json.dumps(law_keys(experiment), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def first_difference(one: Experiment, other: Experiment) -> tuple[str, Any, Any] | None:
    """Key and both values of what is different; None where the law is the same.

    Parameters
    ----------
    one
        experiment
    other
        experiment
    """
    a, b = law_keys(one), law_keys(other)
    for key in sorted(a.keys() | b.keys()):
        if a.get(key) != b.get(key):
            return key, a.get(key), b.get(key)
    return None


def _flat(document: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
