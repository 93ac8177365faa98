# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What this package brings is where ROS 2 looks for it. Run by ``colcon test`` in the workspace that has been built."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

PACKAGE = Path(__file__).parents[1]


@pytest.mark.parametrize("file", sorted((PACKAGE / "launch").glob("*.launch.py")), ids=lambda file: file.stem)
def test_launch_file(file: Path) -> None:
    """With ``launch`` installed it can be described, and every argument says what it is for."""
    launch = pytest.importorskip("launch", reason="no launch here (there are no wheels of it)")
    pytest.importorskip("launch_ros", reason="no launch_ros here (there are no wheels of it)")
    from launch.launch_description_sources import get_launch_description_from_python_launch_file

    description = get_launch_description_from_python_launch_file(str(file))
    assert isinstance(description, launch.LaunchDescription)
    assert all(argument.description for argument in description.get_launch_arguments())


def test_parameter_file() -> None:
    document = yaml.safe_load((PACKAGE / "config" / "nodes.yaml").read_text(encoding="utf-8"))
    assert all(set(section) == {"ros__parameters"} for section in document.values())


def test_examples() -> None:
    """The files themselves are installed, not a link that leads nowhere."""
    installed = Path(get_package_share_directory("msg_agents_bringup")) / "experiments"
    assert not installed.is_symlink()
    assert {file.name for file in installed.iterdir()} == {
        file.name for file in (PACKAGE / "experiments").glob("*.yaml")
    }
    assert (installed / "line_ring.yaml").is_file()
