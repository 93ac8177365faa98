# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Checks of this machine: system, ROS 2, Python."""

from __future__ import annotations

import os
import platform
import resource
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msg_agents.discovery.rtps import RELAYED_PROFILE
from msg_agents.environment import (
    LOGS_VARIABLE,
    MEMORY,
    can_log,
    free_space,
    log_directory,
    node_environment,
    other_logs,
    require_middleware,
    require_rclpy,
    require_shared_memory,
)
from msg_analysis.common.files import no_temporary_directory
from msg_analysis.common.resources import count_cores
from msg_analysis.errors import InputError

Status = Literal["ok", "warning", "error"]  # error: a run cannot work


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line of the doctor: what was found, and, unless it is ok, what to do; see docs/commands.md."""

    name: str
    status: Status
    text: str
    value: float | None = None  # what was measured, in the unit that docs/commands.md names


def warn_if(name: str, warning: str | None, text: str, value: float | None = None) -> CheckResult:
    """A warning if there is one, else ok with the text."""
    return CheckResult(name, "warning" if warning else "ok", warning or text, value)


def refusal(name: str, require: Callable[[], object]) -> CheckResult | None:
    """The error by which a run would refuse this machine or shell; None if it would not."""
    try:
        require()
    except InputError as error:
        return CheckResult(name, "error", str(error))
    return None


MEGABYTE = 1_000_000
LITTLE_MEMORY = 16 * MEGABYTE  # of shared memory; Docker gives a container 67 MB
LITTLE_DISK = 100 * MEGABYTE  # for temporary files; a bag of the demo network has 7 MB
FEW_FILES = 1024  # the usual limit of a process
FEW_PROCESSES = 200  # and threads: a process of nodes has about 10
COARSE = 1e-3  # s


def check_python() -> CheckResult:
    """Which Python makes the run."""
    return CheckResult("python", "ok", f"{platform.python_version()} ({sys.executable})")


def check_cores() -> CheckResult:
    """How many cores this process may use."""
    count = count_cores()
    return CheckResult("cores", "ok", f"{count} that this process may use", count)


def check_clock() -> CheckResult:
    """How fine the clock is that wakes agents in real time."""
    resolution = max(time.get_clock_info(name).resolution for name in ("time", "monotonic"))
    text = f"resolution {resolution:g} s"
    warning = f"{text}: agents in real time are late by so much: use `--pace lockstep`"
    return warn_if("clock", warning if resolution > COARSE else None, text, resolution)


def check_open_files() -> CheckResult:
    """How many files and sockets a process may have open."""
    limit, hardest = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit == resource.RLIM_INFINITY:
        return CheckResult("open_files", "ok", "no limit")
    text = f"at most {limit} in a process"
    raisable = hardest == resource.RLIM_INFINITY or hardest >= FEW_FILES
    remedy = f"`ulimit -n {FEW_FILES}`" if raisable else f"raise the hard limit, {hardest}, as root"
    warning = f"{text}: too few for networks of many processes: {remedy}" if limit < FEW_FILES else None
    return warn_if("open_files", warning, text, limit)


def check_processes() -> CheckResult:
    """How many processes and threads there may still be, by the limits of the user and of the container."""
    left = [limit - used for limit, used in (_limit_of_user(), _limit_of_container()) if limit is not None]
    if not left:
        return CheckResult("processes", "ok", "no limit")
    text = f"{min(left)} more can be started, threads included"
    warning = f"{text}: raise `ulimit -u`, or pids.max of the container" if min(left) < FEW_PROCESSES else None
    return warn_if("processes", warning, text, min(left))


def _limit_of_user() -> tuple[int | None, int]:
    """Limit (None: none) and use; root has none."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    if limit == resource.RLIM_INFINITY or os.geteuid() == 0:
        return None, 0
    used = 0
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            if entry.stat().st_uid == os.getuid():
                used += len(list((entry / "task").iterdir()))
    return limit, used


def _limit_of_container() -> tuple[int | None, int]:
    """Limit (None: none) and use of the control group, where a container shows its own as the root of all."""
    for folder in (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/pids")):
        with suppress(OSError, ValueError):  # "max" among others
            limit, used = (int((folder / f"pids.{what}").read_text(encoding="ascii")) for what in ("max", "current"))
            return limit, used
    return None, 0


def check_shared_memory() -> CheckResult:
    """Room for the states of agents, and for what ROS keeps there."""
    name = "shared_memory"
    if found := refusal(name, require_shared_memory):
        return found
    free = free_space(MEMORY)
    warning = None
    if not os.access(MEMORY, os.W_OK):
        warning = f"{MEMORY}: cannot be written: a run keeps its states in the temporary directory, which is slower"
    elif free < LITTLE_MEMORY:
        warning = (
            f"{MEMORY}: {free / MEGABYTE:.1f} MB free: other ROS 2 programs may fail to start: remove what is not used "
            "(`fastdds shm clean`), or give the container more (`docker run --shm-size 256m`)"
        )
    return warn_if(name, warning, f"{MEMORY}: {free / MEGABYTE:.0f} MB free", free)


def check_temporary_directory() -> CheckResult:
    """Room for the files of a run."""
    name = "temporary_directory"
    try:
        directory = Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        return CheckResult(name, "error", no_temporary_directory(error) or str(error))
    free = free_space(directory)
    text = f"{directory}: {free / MEGABYTE:.0f} MB free"
    warning = f"{text}: long runs need more: set TMPDIR to another directory" if free < LITTLE_DISK else None
    return warn_if(name, warning, text, free)


def check_logs() -> CheckResult:
    """Where ROS nodes write their log files."""
    name, home, directory = "home", os.environ.get("HOME"), log_directory()
    if not can_log():
        what = f"{directory}: cannot be written" if directory else "HOME: not set"
        warning: str | None = (
            f"{what}: nodes of a run log into its temporary folder, other ROS 2 programs may not start: set HOME or "
            f"{LOGS_VARIABLE} to a directory that can be written"
        )
    else:
        warning = None if home else f"HOME: not set (nodes log to {directory}): other programs may need it: set it"
    return warn_if(name, warning, f"{home}, nodes log to {directory}")


PREFIXES_VARIABLE = "AMENT_PREFIX_PATH"
PACKAGES = ("lib/python3*/site-packages", "local/lib/python3*/dist-packages", "lib/python3*/dist-packages")


def check_rclpy() -> CheckResult:
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


def check_middleware() -> CheckResult:
    """Whether that ROS 2 and its middleware can be loaded."""
    name, wanted, warning = "middleware", os.environ.get("RMW_IMPLEMENTATION"), None
    environment = node_environment(0, RELAYED_PROFILE) | other_logs()
    if found := refusal(name, lambda: require_middleware(environment)):
        return found
    if wanted and not wanted.startswith("rmw_fastrtps"):
        warning = (
            f"RMW_IMPLEMENTATION: {wanted}: the profiles of this project are for Fast DDS: processes look for each "
            "other, and may do so beyond this machine: unset it"
        )
    return warn_if(name, warning, wanted or "rmw_fastrtps_cpp (RMW_IMPLEMENTATION is not set)")
