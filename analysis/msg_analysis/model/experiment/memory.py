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

"""How much memory an experiment needs, and how much is available."""

from __future__ import annotations

import os
from pathlib import Path

from msg_analysis.model.experiment.problems import problem

_MATRICES_PER_GRAPH = 8  # adjacency, W, its coupling, F, B, N, the variance of loss, and the product that makes N


def memory_needed(
    agents: int, modes: int, steps: int, replicas: int, delay: int = 0, truth: bool = False
) -> tuple[int, int]:
    """Bytes for the states of a run, and for the matrices of all graphs; ``replicas``: numbers in an agent's state.

    A delay [steps] makes the matrices larger. With ``truth``, states are kept twice: as they are and as published.
    """
    states = (steps + 1) * agents * replicas * 8 * (2 if truth else 1)
    return states, _MATRICES_PER_GRAPH * modes * (agents * (delay + 1)) ** 2 * 8


def available_memory() -> int:
    """Available bytes: what Linux estimates as available, elsewhere all physical memory."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass  # not Linux: all physical memory is the next best number
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def memory_problems(agents: int, modes: int, steps: int, replicas: int, delay: int, truth: bool = False) -> list[str]:
    """Problems if states and matrices do not fit in memory; arguments as in ``memory_needed``."""
    available = available_memory()
    states, matrices = memory_needed(agents, modes, steps, replicas, delay, truth)
    if states + matrices <= available:
        return []
    room = f"expected at most {amount(available)}, the memory available"
    if matrices > states:
        if delay:
            text = f"{delay} steps with {modes} graphs of {agents} agents need {amount(matrices)}"
            return [problem("noise.delay", text, room, "lower the delay, or the number of agents or graphs")]
        text = f"{modes} graphs of {agents} agents need {amount(matrices)}"
        return [problem("graphs", text, room, "lower the number of agents or graphs")]
    text = f"{steps} steps of {agents} agents with {replicas} replicas need {amount(states)}"
    return [problem("run", text, room, "lower run.duration or run.replicas, or raise run.dt")]


def amount(size: float) -> str:
    """A number of bytes as text with a unit: ``1.5 GB``."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:.3g} {unit}"
        size /= 1000
    raise AssertionError
