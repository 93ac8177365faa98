"""Waiting for processes."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def wait_for(condition: Callable[[], Any], seconds: float = 30.0, what: str = "what is waited for") -> Any:
    """Poll until the condition is true; its value."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, f"not within {seconds:g} s: {what}"
        time.sleep(0.02)
    return value


def state_of(pid: int) -> str:
    """Of a process, a letter of proc(5): S if its main thread waits, T if it is stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def gone(pid: int) -> bool:
    """No such process, or only what is left of it in its parent's books."""
    try:
        return state_of(pid) == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def participants(domain: int) -> int:
    """Number of processes of this machine in a ROS domain: each has a port of its own (RTPS, 9.6.1.1)."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    ports = {int(line.split()[1].rpartition(":")[2], 16) for line in lines}
    return sum(7400 + 250 * domain + 10 + 2 * number in ports for number in range(119))
