# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Version of the installed package, and the ROS 2 distribution that it runs with."""

from __future__ import annotations

import functools
import importlib.util
import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

try:
    __version__ = version("msg_analysis")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0.0.0"


@functools.cache
def ros_distribution() -> str:
    """Name of the ROS 2 that rclpy is imported from: jazzy, kilted, ...; empty where nothing tells it."""
    spec = importlib.util.find_spec("rclpy")
    place = Path(spec.origin).parents[1] if spec is not None and spec.origin else None
    return distribution_at(place, os.environ.get("ROS_DISTRO", ""))


def distribution_at(place: Path | None, sourced: str) -> str:
    """The same, for an rclpy in the folder ``place`` and the ROS_DISTRO of a sourced ROS 2.

    Wheels set no variable; ros-<name>-rclpy is installed beside theirs. ROS_DISTRO may be that of another ROS 2 then.
    """
    wheels = sorted(place.glob("ros_*_rclpy-*.dist-info")) if place else []
    return wheels[0].name.split("_")[1] if wheels else sourced
