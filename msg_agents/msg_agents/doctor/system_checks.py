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

"""Python, the machine and its limits."""

from __future__ import annotations

import os
import platform
import resource
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from msg_agents.doctor.check import Check, refusal, warn_if
from msg_agents.processes.environment import LOGS_VARIABLE, can_log, log_directory
from msg_agents.processes.shared_memory import MEMORY, free_space, require_shared_memory
from msg_analysis.common.cores import count_cores
from msg_analysis.common.files import no_temporary_directory

MEGABYTE = 1_000_000
LITTLE_MEMORY = 16 * MEGABYTE  # of shared memory; Docker gives a container 67 MB
LITTLE_DISK = 100 * MEGABYTE  # for temporary files; a bag of the demo network has 7 MB
FEW_FILES = 1024  # the usual limit of a process
FEW_PROCESSES = 200  # and threads: a process of nodes has about 10
COARSE = 1e-3  # s


def check_python() -> Check:
    """Which Python makes the run."""
    return Check("python", "ok", f"{platform.python_version()} ({sys.executable})")


def check_cores() -> Check:
    """How many cores this process may use."""
    count = count_cores()
    return Check("cores", "ok", f"{count} that this process may use", count)


def check_clock() -> Check:
    """How fine the clock is that wakes agents in real time."""
    resolution = max(time.get_clock_info(name).resolution for name in ("time", "monotonic"))
    warning = None
    if resolution > COARSE:
        warning = f"resolution {resolution:g} s: agents in real time are late by so much: use `--pace lockstep`"
    return warn_if("clock", warning, f"resolution {resolution:g} s", resolution)


def check_open_files() -> Check:
    """How many files and sockets a process may have open."""
    limit, hardest = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit == resource.RLIM_INFINITY:
        return Check("open_files", "ok", "no limit")
    warning = None
    if limit < FEW_FILES:
        raisable = hardest == resource.RLIM_INFINITY or hardest >= FEW_FILES
        remedy = f"`ulimit -n {FEW_FILES}`" if raisable else f"raise the hard limit, {hardest}, as root"
        warning = f"at most {limit} in a process: too few for networks of many processes: {remedy}"
    return warn_if("open_files", warning, f"at most {limit} in a process", limit)


def check_processes() -> Check:
    """How many processes and threads there may still be, by the limits of the user and of the container."""
    left = [limit - used for limit, used in (_limit_of_user(), _limit_of_container()) if limit is not None]
    if not left:
        return Check("processes", "ok", "no limit")
    warning = None
    if min(left) < FEW_PROCESSES:
        warning = f"{min(left)} more can be started, threads included: raise `ulimit -u`, or pids.max of the container"
    return warn_if("processes", warning, f"{min(left)} more can be started, threads included", min(left))


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
            return (
                int((folder / "pids.max").read_text(encoding="ascii")),
                int((folder / "pids.current").read_text(encoding="ascii")),
            )
    return None, 0


def check_shared_memory() -> Check:
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


def check_temporary_directory() -> Check:
    """Room for the files of a run."""
    name = "temporary_directory"
    try:
        directory = Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        return Check(name, "error", no_temporary_directory(error) or str(error))
    free = free_space(directory)
    warning = None
    if free < LITTLE_DISK:
        warning = f"{directory}: {free / MEGABYTE:.0f} MB free: long runs need more: set TMPDIR to another directory"
    return warn_if(name, warning, f"{directory}: {free / MEGABYTE:.0f} MB free", free)


def check_logs() -> Check:
    """Where ROS nodes write their log files."""
    name, home, directory = "home", os.environ.get("HOME"), log_directory()
    if not can_log():
        what = f"{directory}: cannot be written" if directory else "HOME: not set"
        return Check(
            name,
            "warning",
            f"{what}: nodes of a run log into its temporary folder, other ROS 2 programs may not start: set HOME or "
            f"{LOGS_VARIABLE} to a directory that can be written",
        )
    warning = None if home else f"HOME: not set (nodes log to {directory}): other programs may need it: set it"
    return warn_if(name, warning, f"{home}, nodes log to {directory}")
