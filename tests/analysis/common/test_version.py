"""The name of the ROS 2 distribution that is used here."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from msg_analysis.common.resources import distribution_at, ros_distribution


def installed(site: Path, *packages: str) -> Path:
    """A folder of packages with the metadata that pip leaves there."""
    for package in packages:
        (site / f"{package}.dist-info").mkdir(parents=True)
    return site


@pytest.mark.parametrize("sourced", ["", "humble", "kilted"])
def test_wheels_name_theirs_whatever_is_sourced(tmp_path: Path, sourced: str) -> None:
    site = installed(tmp_path, "ros_jazzy_rclpy-7.1.6", "ros_rclpy-7.1.6", "ros_jazzy_std_msgs-5.3.6")
    assert distribution_at(site, sourced) == "jazzy"


def test_an_installed_ros_names_itself_in_the_environment(tmp_path: Path) -> None:
    """Its rclpy is found first, in another folder than the wheels; without one, the sourced one or none."""
    assert distribution_at(installed(tmp_path, "numpy-2.0.0"), "kilted") == "kilted"
    assert (distribution_at(None, "jazzy"), distribution_at(None, "")) == ("jazzy", "")


@pytest.mark.parametrize("packages", [(), ("ros_rclpy-7.1.6",), ("ros_jazzy_std_msgs-5.3.6",)])
def test_wheels_that_do_not_say(tmp_path: Path, packages: tuple[str, ...]) -> None:
    assert distribution_at(installed(tmp_path, *packages), "") == ""


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed")
def test_here_it_is_what_pip_lists() -> None:
    listed = subprocess.run([sys.executable, "-m", "pip", "list"], capture_output=True, text=True, check=True).stdout
    wheels = re.findall(r"^ros-([a-z]+)-rclpy ", listed, flags=re.MULTILINE)
    if not wheels:
        pytest.skip("rclpy is not from wheels")
    assert [ros_distribution()] == wheels
