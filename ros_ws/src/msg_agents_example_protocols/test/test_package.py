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

"""The protocols are found by their names where the package is installed. Run by ``colcon test``."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_share_directory

from msg_analysis.model.experiment.experiment import ValidExperiment

EXPERIMENTS = Path(get_package_share_directory("msg_agents_example_protocols")) / "experiments"


@pytest.mark.parametrize("name", ["metropolis", "saturated", "integral_action"])
def test_protocol(name: str) -> None:
    assert name in entry_points(group="msg_agents.protocols").names
    ValidExperiment.load(EXPERIMENTS / f"{name}.yaml").require_available()
