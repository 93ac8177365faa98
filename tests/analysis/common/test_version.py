"""The name of the ROS 2 distribution that is used here."""

import importlib.util
import re
from importlib.metadata import distributions
from pathlib import Path

import pytest

from msg_analysis.common.resources import distribution_at, ros_distribution


@pytest.mark.parametrize(
    ("packages", "sourced", "name"),
    [
        # Wheels name theirs, whatever is sourced; an installed ROS names itself in the environment.
        (["ros_jazzy_rclpy-7.1.6", "ros_rclpy-7.1.6", "ros_jazzy_std_msgs-5.3.6"], "", "jazzy"),
        (["ros_jazzy_rclpy-7.1.6"], "kilted", "jazzy"),
        (["numpy-2.0.0"], "kilted", "kilted"),
        ([], "", ""),
        (["ros_rclpy-7.1.6"], "", ""),
        (["ros_jazzy_std_msgs-5.3.6"], "", ""),
        (None, "jazzy", "jazzy"),
        (None, "", ""),
    ],
)
def test_distribution(packages: list[str] | None, sourced: str, name: str, tmp_path: Path) -> None:
    for package in packages or []:
        (tmp_path / f"{package}.dist-info").mkdir()
    assert distribution_at(None if packages is None else tmp_path, sourced) == name


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed")
def test_here_it_is_that_of_the_installed_packages() -> None:
    wheels = {found[1] for each in distributions() if (found := re.match(r"ros-([a-z]+)-rclpy$", each.name))}
    if not wheels:
        pytest.skip("rclpy is not from wheels")
    assert {ros_distribution()} == wheels
