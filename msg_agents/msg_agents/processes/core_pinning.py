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

"""Which CPU core each process of a network keeps to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import accumulate

from msg_agents.processes.process_plan import RECORDER, ProcessPlan


def place(plans: Sequence[ProcessPlan], cores: Sequence[int], first: int = 0) -> dict[str, int]:
    """A core for each agent process by name, where they and the recorder outnumber two or more cores; else empty.

    ``plans``: in the order of ``plan_network``, so that neighbours share a core. ``first``: index of the first core.
    """
    # In lockstep every message wakes the process that receives it. To wake it on another core costs an interrupt there,
    # and without pinning the scheduler spreads communicating processes over the cores: with two cores, the demo network
    # makes a third to a half fewer steps per second (docs/performance.md). Networks with successive values of ``first``
    # begin at different cores, and so share them evenly. The recorder gets no core: agents wait for each other, so a
    # core that it slows down holds up the others, which then are idle; the scheduler moves it there. The switcher needs
    # hardly any time.
    loads = {plan.name: len(plan.agents) for plan in plans if plan.agents}
    recorded = any(plan.name == RECORDER for plan in plans)
    if len(cores) < 2 or len(loads) + recorded <= len(cores):
        return {}
    total = sum(loads.values())
    ends = accumulate(loads.values())
    middles = {name: end - load / 2 for (name, load), end in zip(loads.items(), ends, strict=True)}
    return {name: cores[(first + int(middle / total * len(cores))) % len(cores)] for name, middle in middles.items()}


def keep_to(process: int, core: int) -> None:
    """Pin a process that has just been started, and its children, to a core; errors are ignored."""
    try:
        os.sched_setaffinity(process, {core})
    except OSError:  # it has ended already, or the core has been taken from us
        return
