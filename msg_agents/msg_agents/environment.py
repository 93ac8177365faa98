# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The environment of the processes of a run."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from msg_agents.discovery.relay import DiscoveryRelay
from msg_agents.discovery.rtps import (
    LOOPBACK_PROFILE,
    PROFILE_VARIABLES,
    RELAYED_PROFILE,
    UDP_PROFILE,
    domains_for,
    free_domain,
    has_fast_dds_3,
    require_loopback,
)
from msg_analysis.common import programs
from msg_analysis.common.resources import SINGLE_THREAD, ros_distribution
from msg_analysis.common.shared_folders import own_folder
from msg_analysis.errors import InputError

MEMORY = Path("/dev/shm")  # a page of a file on a disk costs twice as much to write, each time the system has saved it
LEAST_FREE = 64 << 10  # bytes; where a page that ROS maps there cannot be had, the processes of a run die of SIGBUS
# With none of these, rclpy, its libraries and its middleware can only be those of this Python.
FOREIGN_VARIABLES = ("RMW_IMPLEMENTATION", "PYTHONPATH", "AMENT_PREFIX_PATH", "ROS_DISTRO")
PROBE_TIMEOUT = 60.0  # s
PROBE = """
import importlib.util, os, warnings
warnings.simplefilter("ignore")
print(os.path.dirname(importlib.util.find_spec("rclpy").origin), flush=True)
from msg_agents.nodes.ros import use_middleware
use_middleware()
"""
TRANSPORTS_VARIABLE = "FASTDDS_BUILTIN_TRANSPORTS"
RESTARTS = 3  # of killed processes in a run, by default
LAST_DOMAIN = 231  # 232, the last of ROS, has ports for some 60 participants only
DISCOVERY_TIMEOUT = 30.0  # s for which nodes look for each other in small networks
USER_TIMEOUT = 120.0  # s for which they look for others that the user starts
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCALHOST_VARIABLE = "ROS_LOCALHOST_ONLY"  # older; 1 is still stronger, and adds shared memory as LOCALHOST does
SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"
LOGS_VARIABLE = "ROS_LOG_DIR"
ROS_LOGS = "ros"  # folder for nodes that have no other place for the log files of ROS


def free_space(directory: Path) -> int:
    """Bytes that we could write there."""
    try:
        return shutil.disk_usage(directory).free if os.access(directory, os.W_OK) else 0
    except OSError:
        return 0


def require_shared_memory(directory: Path = MEMORY) -> None:
    """InputError if it is full. Without it, or where it cannot be written, a run does without."""
    # The library of the tracer LTTng, which rclpy loads, makes a file of one page there and writes to it.
    if os.access(directory, os.W_OK) and (free := free_space(directory)) < LEAST_FREE:
        raise InputError(
            f"{directory}: full ({free} bytes free): ROS 2 processes would be killed by SIGBUS: remove what is not "
            "used, with `fastdds shm clean` or by hand"
        )


def require_rclpy() -> Path:
    """The folder of the rclpy that this Python finds; InputError: there is none."""
    found = importlib.util.find_spec("rclpy")
    if found is None or found.origin is None:
        raise InputError(
            f"rclpy: not found by {sys.executable}: run `make setup`, or use a terminal in which ROS 2 is sourced"
        )
    return Path(found.origin).parent.resolve()


def require_middleware(environment: Mapping[str, str], forked: Callable[[], bool] = lambda: False) -> None:
    """InputError, with the variable to unset, unless rclpy and the messages can be loaded in this environment."""
    require_rclpy()
    # Only where a variable could lead to another ROS 2 than that of this Python; a forked process saves the imports.
    present = [name for name in FOREIGN_VARIABLES if environment.get(name)]
    if not present or forked():
        return
    try:
        probe = programs.run([sys.executable, "-c", PROBE], environment, PROBE_TIMEOUT)
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


def check_domain() -> None:
    """InputError if the environment's ROS_DOMAIN_ID is not usable; to be called before the middleware starts."""
    value = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not value.isdecimal() or int(value) > LAST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID: {value}: expected a number from 0 to {LAST_DOMAIN}")


def discovery_scope() -> str:
    """Where the nodes of this process find others, as text."""
    domain, reach = os.environ.get("ROS_DOMAIN_ID") or "0", os.environ.get(RANGE_VARIABLE) or "SUBNET"
    return f"in ROS_DOMAIN_ID {domain} and within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}"


def log_directory() -> Path | None:
    """Where ROS writes its log files by the environment; None without a home."""
    ros_home, home = os.environ.get("ROS_HOME"), os.environ.get("HOME")
    place = os.environ.get(LOGS_VARIABLE) or (ros_home and f"{ros_home}/log") or (home and f"{home}/.ros/log")
    return Path(place).expanduser() if place else None


def can_log() -> bool:
    """Whether ROS can write its log files, without which no node starts: not on a read-only root, for example."""
    with suppress(OSError):
        if path := log_directory():
            path.mkdir(parents=True, exist_ok=True)
            return os.access(path, os.W_OK | os.X_OK)
    return False


def other_logs(directory: Path | None = None) -> dict[str, str]:
    """Changes to our environment that let ROS log to a directory (None: ours) if it cannot write to the usual one."""
    return {} if can_log() else {LOGS_VARIABLE: str(directory or own_folder() / ROS_LOGS)}


def require_discovery(environment: Mapping[str, str]) -> None:
    """InputError if nodes may not find each other in this environment."""
    if environment.get(RANGE_VARIABLE) == "OFF":
        raise InputError(f"{RANGE_VARIABLE}: OFF: the nodes of a run would not find each other: unset it")


def tolerate_warnings() -> None:
    """Let rclpy be imported where PYTHONWARNINGS makes errors of warnings: a package that it uses is deprecated."""
    warnings.filterwarnings("ignore", "module 'sre_", DeprecationWarning)


def profile_variables(profile: Path, distribution: str | None = None) -> dict[str, str]:
    """What leads Fast DDS to a profile, by default that of the ROS 2 here: Fast DDS 3 warns of the old name."""
    name = ros_distribution() if distribution is None else distribution
    read = PROFILE_VARIABLES[1:] if has_fast_dds_3(name) else PROFILE_VARIABLES
    return dict.fromkeys(read, str(profile))


def node_environment(domain: int, profile: Path = LOOPBACK_PROFILE) -> dict[str, str]:
    """Our environment with what the nodes need; another discovery range or profile of the user's is kept."""
    own = {"PYTHONUNBUFFERED": "1", "ROS_DOMAIN_ID": str(domain)}
    given = {name: value for name, value in os.environ.items() if value}  # empty is unset, as in ROS 2 and Python
    environment = {**SINGLE_THREAD, **given, **own}
    local = environment.get(RANGE_VARIABLE, "LOCALHOST") == "LOCALHOST"
    if local and not any(environment.get(name) for name in PROFILE_VARIABLES):
        environment[RANGE_VARIABLE] = "SYSTEM_DEFAULT"  # the profile decides
        environment.update(profile_variables(profile))
        for name in (SERVER_VARIABLE, LOCALHOST_VARIABLE):  # with a server, nodes would find each other only through it
            environment.pop(name, None)
    return environment


def channel_environment(profile: Path) -> dict[str, str]:
    """Changes to our environment that make the middleware follow a profile, whatever the user has set."""
    return {  # the user's shared memory, discovery server or discovery range would lead messages past the channel
        **profile_variables(profile),
        RANGE_VARIABLE: "SYSTEM_DEFAULT",
        TRANSPORTS_VARIABLE: "",
        LOCALHOST_VARIABLE: "",
        SERVER_VARIABLE: "",
    }


def without_shared_memory() -> dict[str, str]:
    """Changes to our environment for a process that ends at once: UDP only, so that no shared memory is left behind."""
    if any(os.environ.get(name) for name in (*PROFILE_VARIABLES, TRANSPORTS_VARIABLE)):
        return {}
    # Both add shared memory to any profile.
    if os.environ.get(RANGE_VARIABLE) == "LOCALHOST" or os.environ.get(LOCALHOST_VARIABLE) == "1":
        return {RANGE_VARIABLE: "SYSTEM_DEFAULT", LOCALHOST_VARIABLE: "", **profile_variables(LOOPBACK_PROFILE)}
    return profile_variables(UDP_PROFILE)


@contextmanager
def run_environment(
    folder: Path,  # of the run
    domain: int | None,  # None: a free one
    changes: Mapping[str, str],  # of the environment
    participants: int,  # of the run
) -> Iterator[tuple[int, dict[str, str], DiscoveryRelay | None]]:
    """Domain, environment variables and relay of a run; InputError: no free domain, or processes cannot meet."""
    with ExitStack() as stack:
        if domain is None:
            domain = stack.enter_context(free_domain(domains_for(participants)))
        relay = None
        if uses_relay(changes):
            require_loopback()
            with suppress(OSError):  # many others are in this domain
                relay = stack.enter_context(DiscoveryRelay(domain))
        # The relayed profile announces to the relay only: without it, no process would find another.
        environment = node_environment(domain, RELAYED_PROFILE if relay else LOOPBACK_PROFILE) | dict(changes)
        require_discovery(environment)
        require_shared_memory()
        environment |= other_logs(folder / ROS_LOGS)
        yield domain, environment, relay


def uses_relay(changes: Mapping[str, str]) -> bool:
    """Whether the middleware will follow our profile: not if that of the user, or of several hosts, is used."""
    environment = node_environment(0, RELAYED_PROFILE) | dict(changes)
    ours = environment.get(PROFILE_VARIABLES[-1]) == str(RELAYED_PROFILE)
    return ours and (environment.get("RMW_IMPLEMENTATION") or "rmw_fastrtps").startswith("rmw_fastrtps")
