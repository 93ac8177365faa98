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

"""An experiment file with other values of ``run``, from a command line or a launch file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ExperimentError, ValidExperiment
from msg_analysis.model.experiment.yaml_document import read_yaml


def load_with_overrides(
    path: Path, run: Mapping[str, Any], *, name: Callable[[str], str] = "--{}".format
) -> ValidExperiment:
    """The experiment, checked once, after values of ``run`` were replaced; None replaces nothing.

    ``processes`` may be a number as text. ``name``: how errors call the new value of a key.
    """
    changes = {key: value for key, value in run.items() if value is not None}
    if str(changes.get("processes", "")).isdigit():
        changes["processes"] = int(changes["processes"])
    document = read_yaml(path)
    if not changes or not isinstance(document, dict) or not isinstance(section := document.get("run", {}), dict):
        return ValidExperiment.parse(document, source=str(path), directory=path.parent)
    changed = document | {"run": section | changes}
    try:
        return ValidExperiment.parse(changed, source=str(path), directory=path.parent)
    except InputError as error:
        ValidExperiment.parse(document, source=str(path), directory=path.parent)  # the fault may be the file's
        problems = error.problems if isinstance(error, ExperimentError) else []
        wrong = [key for key in changes if any(line.startswith(f"run.{key}:") for line in problems)]
        given = ", ".join(name(key) for key in wrong or changes)
        return ValidExperiment.parse(changed, source=given, directory=path.parent)
