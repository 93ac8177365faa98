"""Cores of the machine that this process may use: affinity and cpusets, as in containers, included."""

from __future__ import annotations

import os


def available_cores() -> list[int]:
    """Their numbers, ascending; none where the system does not say (not Linux)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def count_cores() -> int:
    """How many there are; all of the machine where the system does not say."""
    return len(available_cores()) or os.cpu_count() or 1
