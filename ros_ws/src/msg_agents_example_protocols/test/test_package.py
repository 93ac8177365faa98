# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The protocols are found by their names where the package is installed. Run by ``colcon test``."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_share_directory

from msg_analysis.experiment.experiment import Experiment

EXPERIMENTS = Path(get_package_share_directory("msg_agents_example_protocols")) / "experiments"


@pytest.mark.parametrize("name", ["metropolis", "saturated", "integral_action"])
def test_protocol(name: str) -> None:
    assert name in entry_points(group="msg_agents.protocols").names
    Experiment.load(EXPERIMENTS / f"{name}.yaml").require_available()
