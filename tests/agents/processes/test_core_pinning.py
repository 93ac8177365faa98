"""Which processor core each process of a network keeps to."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from msg_agents.process_layout import RECORDER, SWITCHER, ProcessSpec, pin_to_core, place
from msg_analysis.common.resources import available_cores


def plans(agents: int, processes: int, *, recorder: bool) -> list[ProcessSpec]:
    bounds = [index * agents // processes for index in range(processes + 1)]
    shares = [tuple(range(*ends)) for ends in pairwise(bounds)]
    first = [ProcessSpec(RECORDER, ())] if recorder else []
    return [*first, *(ProcessSpec(f"p{share[0]}", (), share) for share in shares), ProcessSpec(SWITCHER, ())]


@given(st.integers(2, 16), st.integers(1, 30), st.integers(0, 70), st.booleans(), st.integers(0, 232))
def test_neighbours_share_a_core_and_cores_share_the_work(
    cores: int, processes: int, more: int, recorder: bool, first: int
) -> None:
    network = plans(processes + more, processes, recorder=recorder)
    numbers = [3 * core + 1 for core in range(cores)]  # of a machine that has given us some of its cores
    placed = place(network, numbers, first)
    if processes + recorder <= cores:
        assert placed == {}
        return
    pinned = [plan for plan in network if plan.agents]
    assert list(placed) == [plan.name for plan in pinned]
    order = [placed[plan.name] for plan in pinned]
    assert set(order) <= set(numbers)
    changes = sum(a != b for a, b in pairwise(order))
    assert changes == len(set(order)) - 1  # whoever shares a core is next to each other
    loads = {plan.name: len(plan.agents) for plan in pinned}
    work = [sum(loads[name] for name, core in placed.items() if core == number) for number in numbers]
    assert max(work) <= sum(work) / cores + max(loads.values())


def test_the_demo_network_on_two_cores() -> None:
    network = plans(5, 5, recorder=True)
    assert place(network, [0, 1]) == {"p0": 0, "p1": 0, "p2": 1, "p3": 1, "p4": 1}
    assert place(network, [0, 1], first=1) == {"p0": 1, "p1": 1, "p2": 0, "p3": 0, "p4": 0}
    assert place(network, [0]) == {}
    assert place(network, []) == {}  # the system does not say


def test_a_process_and_what_it_starts_keep_to_the_core() -> None:
    core = available_cores()[-1]
    code = "import os, sys; sys.stdin.read(); os.execvp('grep', ['grep', 'Cpus_allowed_list', '/proc/self/status'])"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        pin_to_core(child.pid, core)
        output, _ = child.communicate()
    assert output.split() == [b"Cpus_allowed_list:", str(core).encode()]
    pin_to_core(child.pid, core)  # gone: nothing happens
    assert len(available_cores()) == len(os.sched_getaffinity(0))
