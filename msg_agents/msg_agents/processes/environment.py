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

"""The environment of the processes of a run."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path

from msg_agents.discovery.profiles import LOOPBACK_PROFILE, PROFILE_VARIABLES, UDP_PROFILE, has_fast_dds_3
from msg_analysis.common.blas_threads import SINGLE_THREAD
from msg_analysis.common.version import ros_distribution
from msg_analysis.errors import InputError

TRANSPORTS_VARIABLE = "FASTDDS_BUILTIN_TRANSPORTS"
RESTARTS = 3  # of killed processes in a run, by default
LAST_DOMAIN = 231  # 232, the last of ROS, has ports for some 60 participants only
DISCOVERY_TIMEOUT = 30.0  # s for which nodes look for each other in small networks
USER_TIMEOUT = 120.0  # s for which they look for others that the user starts
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCALHOST_VARIABLE = "ROS_LOCALHOST_ONLY"  # older; 1 is still stronger, and adds shared memory as LOCALHOST does
SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"
LOGS_VARIABLE = "ROS_LOG_DIR"


def check_domain() -> None:
    """InputError if the environment's ROS_DOMAIN_ID is not usable; to be called before the middleware starts."""
    value = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not value.isdecimal() or int(value) > LAST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID: {value}: expected a number from 0 to {LAST_DOMAIN}")


def discovery_scope() -> str:
    """Where the nodes of this process find others, as text."""
    domain, reach = os.environ.get("ROS_DOMAIN_ID", "0"), os.environ.get(RANGE_VARIABLE, "SUBNET")
    return f"in ROS_DOMAIN_ID {domain} and within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}"


def log_directory() -> Path | None:
    """Where ROS writes its log files by the environment; None without a home."""
    ros_home, home = os.environ.get("ROS_HOME"), os.environ.get("HOME")
    place = os.environ.get(LOGS_VARIABLE) or (ros_home and f"{ros_home}/log") or (home and f"{home}/.ros/log")
    return Path(place).expanduser() if place else None


def can_log() -> bool:
    """Whether ROS can write its log files where the environment says: not without a home, on a read-only root, ...

    Without them no node starts.
    """
    path = log_directory()
    if path is None:
        return False
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(path, os.W_OK | os.X_OK)


def other_logs(directory: Path) -> dict[str, str]:
    """Changes to our environment that let ROS log to a directory, if it cannot write to the usual one."""
    return {} if can_log() else {LOGS_VARIABLE: str(directory)}


def ensure_logs() -> None:
    """Give this process another directory for the log files of ROS if it cannot write to the usual one."""
    os.environ.update(other_logs(Path(tempfile.gettempdir()) / f"msg_agents_log_{os.getuid()}"))


def require_discovery(environment: Mapping[str, str]) -> None:
    """InputError if nodes may not find each other in this environment."""
    if environment.get(RANGE_VARIABLE) == "OFF":
        raise InputError(f"{RANGE_VARIABLE}: OFF: the nodes of a run would not find each other: unset it")


def tolerate_warnings() -> None:
    """Let rclpy be imported where PYTHONWARNINGS makes errors of warnings: a package that it uses is deprecated."""
    warnings.filterwarnings("ignore", "module 'sre_", DeprecationWarning)


def start_environment() -> dict[str, str]:
    """Our environment with what is read at the start of a process of nodes, whatever its network."""
    return {
        **SINGLE_THREAD,
        **os.environ,
        "PYTHONUNBUFFERED": "1",
        # ``python -m`` would look for msg_agents in the working directory first, and find our source tree's folder.
        "PYTHONSAFEPATH": "1",
    }


def profile_variables(profile: Path, distribution: str | None = None) -> dict[str, str]:
    """What leads Fast DDS to a profile, by default that of the ROS 2 here: Fast DDS 3 warns of the old name."""
    name = ros_distribution() if distribution is None else distribution
    read = PROFILE_VARIABLES[1:] if has_fast_dds_3(name) else PROFILE_VARIABLES
    return dict.fromkeys(read, str(profile))


def node_environment(domain: int, profile: Path = LOOPBACK_PROFILE) -> dict[str, str]:
    """Our environment with what the nodes need; another discovery range or profile of the user's is kept.

    A discovery server is not used: with one, the nodes of a run on this machine would not find each other without it.
    """
    environment = start_environment() | {"ROS_DOMAIN_ID": str(domain)}
    local = environment.get(RANGE_VARIABLE, "LOCALHOST") == "LOCALHOST"
    if local and not any(environment.get(name) for name in PROFILE_VARIABLES):
        environment[RANGE_VARIABLE] = "SYSTEM_DEFAULT"  # the profile decides
        environment.update(profile_variables(profile))
        for name in (SERVER_VARIABLE, LOCALHOST_VARIABLE):
            environment.pop(name, None)
    return environment


def channel_environment(profile: Path) -> dict[str, str]:
    """Changes to our environment that make the middleware follow a profile, whatever the user has set.

    Shared memory, a discovery server or a discovery range of the user's would lead messages past the channel.
    """
    return {
        **profile_variables(profile),
        RANGE_VARIABLE: "SYSTEM_DEFAULT",
        TRANSPORTS_VARIABLE: "",
        LOCALHOST_VARIABLE: "",
        SERVER_VARIABLE: "",
    }


def without_shared_memory() -> dict[str, str]:
    """Changes to our environment that make the middleware use UDP only; the user's profile or transports are kept.

    A process that ends at once would otherwise leave shared memory behind.
    """
    if any(os.environ.get(name) for name in (*PROFILE_VARIABLES, TRANSPORTS_VARIABLE)):
        return {}
    # Both add shared memory to any profile.
    if os.environ.get(RANGE_VARIABLE) == "LOCALHOST" or os.environ.get(LOCALHOST_VARIABLE) == "1":
        return {
            RANGE_VARIABLE: "SYSTEM_DEFAULT",
            LOCALHOST_VARIABLE: "",
            **profile_variables(LOOPBACK_PROFILE),
        }
    return profile_variables(UDP_PROFILE)
