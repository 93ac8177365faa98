"""An experiment file with other values of ``run``, from a command line or a launch file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.yaml_document import read_yaml


def load_with_overrides(path: Path, run: Mapping[str, Any]) -> ValidExperiment:
    """The experiment, checked once, after values of ``run`` were replaced; None replaces nothing.

    ``processes`` may be a number as text.
    """
    changes = {key: value for key, value in run.items() if value is not None}
    if str(changes.get("processes", "")).isdigit():
        changes["processes"] = int(changes["processes"])
    document = read_yaml(path)
    if isinstance(document, dict) and isinstance(section := document.get("run", {}), dict):
        document["run"] = section | changes
    return ValidExperiment.parse(document, source=str(path), directory=path.parent)
