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

"""Whether ROS 2 can be used in this environment: asked before the processes of a run start, which would all fail."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from msg_analysis.errors import InputError

# With none of these, rclpy, its libraries and its middleware can only be those of this Python.
SUSPECTS = ("RMW_IMPLEMENTATION", "PYTHONPATH", "AMENT_PREFIX_PATH", "ROS_DISTRO")
PATIENCE = 60.0  # s
PROBE = """
import importlib.util, os, warnings
warnings.simplefilter("ignore")
print(os.path.dirname(importlib.util.find_spec("rclpy").origin), flush=True)
from msg_agents.nodes.ros.middleware import use_middleware
use_middleware()
"""


def require_rclpy() -> Path:
    """The folder of the rclpy that this Python finds; InputError: there is none."""
    found = importlib.util.find_spec("rclpy")
    if found is None or found.origin is None:
        raise InputError(
            f"rclpy: not found by {sys.executable}: run `make setup`, or use a terminal in which ROS 2 is sourced"
        )
    return Path(found.origin).parent.resolve()


def require_middleware(environment: Mapping[str, str], forked: Callable[[], bool] = lambda: False) -> None:
    """InputError, with the variable to unset, unless rclpy and the messages can be loaded in this environment.

    It is tried, in a process of its own, only where a variable could lead to another ROS 2 than that of this Python.
    ``forked``: whether a process could that was forked from one which has imported all; it saves the imports.
    """
    require_rclpy()
    present = [name for name in SUSPECTS if environment.get(name)]
    if not present or forked():
        return
    try:
        probe = subprocess.run(
            [sys.executable, "-P", "-c", PROBE],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return  # a busy machine: the run will say what is wrong
    if probe.returncode == 0:
        return
    wanted = environment.get("RMW_IMPLEMENTATION")
    found = re.search(r"instead found '(\w+)'", probe.stderr)
    if wanted and (found or wanted in probe.stderr):
        has = f"this ROS 2 has {found[1]}" if found else "this ROS 2 cannot load it"
        raise InputError(f"RMW_IMPLEMENTATION: {wanted}: {has}: unset it, or install that middleware")
    lines = [line for line in probe.stderr.splitlines() if line.strip()]
    reason = lines[-1].strip() if lines else f"exit code {probe.returncode}"
    place = probe.stdout.strip()
    raise InputError(
        f"{place or 'rclpy'}: cannot be used ({reason}): {' and '.join(present)} may lead to another ROS 2: unset "
        f"{'it' if len(present) == 1 else 'them'}, or use a terminal in which no other ROS 2 is sourced"
    )
