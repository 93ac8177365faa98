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

"""Which ROS 2 and which middleware a run would use."""

from __future__ import annotations

import os
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from pathlib import Path

from msg_agents.discovery.profiles import INTRODUCED_PROFILE
from msg_agents.doctor.check import Check, refusal, warn_if
from msg_agents.processes.environment import node_environment, other_logs
from msg_agents.processes.middleware_check import require_middleware, require_rclpy

PREFIXES_VARIABLE = "AMENT_PREFIX_PATH"
PACKAGES = ("lib/python3*/site-packages", "local/lib/python3*/dist-packages", "lib/python3*/dist-packages")
DEFAULT_MIDDLEWARE = "rmw_fastrtps_cpp"


def check_rclpy() -> Check:
    """Which ROS 2 the run would load, and which others it could be confused with."""
    name = "rclpy"
    if found := refusal(name, require_rclpy):
        return found
    winner = require_rclpy()
    ours = {Path(sysconfig.get_path(key)).resolve() for key in ("purelib", "platlib")}
    kind = "the wheel of this Python" if winner.parent in ours else "a ROS installation"
    others = sorted({str(place) for place in _places() if place != winner})
    warning = None
    if others:
        warning = (
            f"{winner} wins over {', '.join(others)}: programs of the other ROS 2 may not work with it: use a terminal "
            f"in which no other ROS 2 is sourced, or unset PYTHONPATH and {PREFIXES_VARIABLE}"
        )
    return warn_if(name, warning, f"{kind} ({winner})")


def _places() -> Iterator[Path]:
    """Folders of every rclpy that Python's path or a sourced ROS installation has."""
    prefixes = [Path(prefix) for prefix in os.environ.get(PREFIXES_VARIABLE, "").split(os.pathsep) if prefix]
    folders = [Path(entry) for entry in sys.path if entry]
    folders += [folder for prefix in prefixes for pattern in PACKAGES for folder in prefix.glob(pattern)]
    for folder in folders:
        if (folder / "rclpy/__init__.py").is_file():
            yield (folder / "rclpy").resolve()


def check_middleware() -> Check:
    """Whether that ROS 2 and its middleware can be loaded."""
    name = "middleware"
    wanted = os.environ.get("RMW_IMPLEMENTATION")
    environment = node_environment(0, INTRODUCED_PROFILE) | other_logs(Path(tempfile.gettempdir()))
    if found := refusal(name, lambda: require_middleware(environment)):
        return found
    warning = None
    if wanted and not wanted.startswith("rmw_fastrtps"):
        warning = (
            f"RMW_IMPLEMENTATION: {wanted}: the profiles of this project are for Fast DDS: processes look for each "
            "other, and may do so beyond this machine: unset it"
        )
    return warn_if(name, warning, wanted or f"{DEFAULT_MIDDLEWARE} (RMW_IMPLEMENTATION is not set)")
