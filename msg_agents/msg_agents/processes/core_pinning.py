"""Which processor core each process of a network keeps to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import accumulate

from msg_agents.processes.process_plan import RECORDER, ProcessPlan

RECORDING = 0.25
"""What a message costs the recorder, as part of what the step that made it costs the agent."""


def available_cores() -> list[int]:
    """The cores that this process may use, ascending; none where the system does not say (it is not Linux)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def place(plans: Sequence[ProcessPlan], cores: Sequence[int], first: int = 0) -> dict[str, int]:
    """A core for each process, where there are more of them than cores.

    In lockstep every message wakes the process that it is for. To wake it on another core costs an interrupt there,
    and left alone the scheduler spreads those who wake each other over the cores: with two, the demo network makes a
    third to a half fewer steps per second (docs/performance.md). Where every process can have a core of its own, the
    scheduler is left alone.

    Parameters
    ----------
    plans
        in the order of ``plan_network``, in which neighbours are next to each other: they share a core
    cores
        numbers of the cores
    first
        any number; networks that are given successive ones begin at different cores, and so share them evenly

    Returns
    -------
    dict[str, int]
        core by name of the process; the switcher, which has hardly anything to do, is not in it
    """
    agents = sum(len(plan.agents) for plan in plans)
    loads = {
        plan.name: len(plan.agents) or RECORDING * agents for plan in plans if plan.agents or plan.name == RECORDER
    }
    if len(cores) < 2 or len(loads) <= len(cores):
        return {}
    total = sum(loads.values())
    ends = accumulate(loads.values())
    middles = {name: end - load / 2 for (name, load), end in zip(loads.items(), ends, strict=True)}
    return {name: cores[(first + int(middle / total * len(cores))) % len(cores)] for name, middle in middles.items()}


def keep_to(process: int, core: int) -> None:
    """Keep a process that has just been started, and what it starts, to a core; not if the system will not have it.

    Parameters
    ----------
    process
        its id
    core
        number of the core, as the system has it
    """
    try:
        os.sched_setaffinity(process, {core})
    except OSError:  # it has ended already, or the core has been taken from us
        return
