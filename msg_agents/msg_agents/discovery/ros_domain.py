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

"""A ROS domain for each run, so that two runs on one machine do not hear each other."""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from msg_analysis.errors import InputError

DOMAINS = range(1, 102)
"""0 is the default of every ROS program; above 101 the ports are among the ephemeral ports of Linux."""

PORT_BASE, PORTS_PER_DOMAIN = 7400, 250  # the RTPS rule for well-known ports


def domains_with_ports_in_use() -> set[int]:
    """Domains of which somebody has bound a UDP port on this machine."""
    ports: set[int] = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        try:
            lines = Path(table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        ports.update(int(line.split()[1].rpartition(":")[2], 16) for line in lines)
    return {(port - PORT_BASE) // PORTS_PER_DOMAIN for port in ports}


def _open_lock(path: Path) -> int:
    """Open a lock file, which may belong to another user.

    Such a file can be read and locked, but not opened for writing nor, in a directory like /tmp, with O_CREAT.
    """
    try:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return os.open(path, os.O_RDONLY | os.O_CREAT, 0o644)


@contextmanager
def free_domain(count: int = 1) -> Iterator[int]:
    """Hold a ROS_DOMAIN_ID that no other run holds and whose ports are unused; InputError if there is none.

    ``count``: as many in a row, for a network that needs their ports; the first one is its domain. They are held by
    locks on files, which the system releases when this process ends, however it ends.
    """
    busy = domains_with_ports_in_use()
    free = [domain for domain in DOMAINS if domain not in busy]
    candidates = [first for first in free if set(range(first, first + count)) <= set(free)]
    random.shuffle(candidates)
    for first in candidates:
        with ExitStack() as locks:
            if all(_lock(domain, locks) for domain in range(first, first + count)):
                yield first
                return
    raise InputError(f"no free ROS domain among {DOMAINS[0]}..{DOMAINS[-1]}: end some runs or give --domain")


def held_domains() -> list[int]:
    """The domains that runs on this machine hold."""
    names = (file.stem.rpartition("_")[2] for file in Path(tempfile.gettempdir()).glob(_lock_name("*")))
    return sorted(domain for domain in map(int, filter(str.isdecimal, names)) if domain in DOMAINS and is_held(domain))


def is_held(domain: int) -> bool:
    """Whether a run holds a domain."""
    with ExitStack() as locks:
        return not _lock(domain, locks)


def _lock_name(domain: str) -> str:
    return f"msg_agents_domain_{domain}.lock"


def _lock(domain: int, locks: ExitStack) -> bool:
    """Lock a domain until the end of ``locks``; whether that was possible."""
    try:
        descriptor = _open_lock(Path(tempfile.gettempdir()) / _lock_name(str(domain)))
    except OSError:
        return False
    locks.callback(os.close, descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
