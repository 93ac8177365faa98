"""Long runs: in files, and block after block, with memory for one block."""

import dataclasses
import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import Experiment, check, flipped, line_ring, new_record, simulate, stored
from msg_analysis.common.arrays import LARGE_VARIABLE, in_file
from msg_analysis.inference.verdict import compare_run
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.reception import MessagesUsed

RUNS: dict[str, dict[str, Any]] = {
    "lost": {"noise": {"loss": 0.3}},
    "late": {"noise": {"delay": 2}},
    "held": {"noise": {"loss": 0.3, "on_loss": "hold", "delay": 1, "broadcast": 0.1}},
    "noisy": {"noise": {"broadcast": 0.2, "link": 0.3}},
    "real time": {"noise": {"loss": 0.2, "broadcast": 0.2, "link": 0.1}, "run": {"pace": "realtime"}},
    "protocol": {
        "protocol": {"name": "saturated"},
        "noise": {"loss": 0.3, "on_loss": "hold"},
        "run": {"start": "zero"},
    },
    "protocol in real time": {
        "protocol": {"name": "saturated"},
        "noise": {"loss": 0.2, "broadcast": 0.1},
        "run": {"start": "zero", "pace": "realtime"},
    },
}


def long_run(case: str, steps: int, replicas: int = 2, agents: int = 5) -> Experiment:
    changes = RUNS[case]
    run = {"duration": 0.05 * steps, "replicas": replicas, "seed": 5} | changes.get("run", {})
    return line_ring(agents, **changes | {"run": run})


@pytest.mark.parametrize("case", RUNS)
def test_the_same_in_files(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twin, bag and check; a bit that is turned over behind two blocks of steps is found."""
    what = long_run(case, 600)
    twin = simulate(what)
    monkeypatch.setenv(LARGE_VARIABLE, "1")
    again = simulate(what, record=twin.record)
    for name in ("states", "published", "lost", "used", "made", "agent_modes"):
        one, other = getattr(twin, name), getattr(again, name)
        np.testing.assert_array_equal(one, other, name)
        assert one is None or in_file(other) > in_file(one), name
    assert check(stored(again, tmp_path)).difference is None
    changed = dataclasses.replace(twin, states=flipped(twin.states, 551, 3, 1))
    outcome = check(stored(changed, tmp_path / "changed"))
    assert outcome.difference.startswith("agent 4 at step 551, replica 2: ")


@pytest.mark.parametrize("case", ["held", "noisy", "real time", "protocol"])
def test_check_needs_memory_for_a_block(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the steps need hardly more memory: 8 bytes of each step for its graph, and as much for a copy."""
    monkeypatch.setenv(LARGE_VARIABLE, "1")
    runs = [simulate(long_run(case, steps, replicas=4, agents=3)) for steps in (768, 1_280)]
    short, long = (_peak(lambda run=run: check(run)) for run in runs)
    assert long - short < 512 * 32


@pytest.mark.parametrize("case", ["real time", "protocol in real time"])
def test_comparison_needs_memory_for_a_block(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the steps need at most some numbers more for each; its states alone have 192 bytes."""
    monkeypatch.setenv(LARGE_VARIABLE, "1")
    runs = [simulate(long_run(case, steps, replicas=8, agents=3)) for steps in (60, 120)]
    for run in runs:  # what is kept for comparisons to come
        compare_run(run, block_numbers=400)
    short, long = (_peak(lambda run=run: compare_run(run, block_numbers=400)) for run in runs)
    assert long - short < 60 * 96


def _peak(work: Callable[[], object]) -> int:
    """Most bytes in use at once in some work, less those of before."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("case", ["lost", "late", "held", "real time"])
def test_messages_of_a_part_of_the_steps(case: str) -> None:
    """In any cuts they are those of the whole run."""
    what = long_run(case, 700)
    model = new_record(what).model
    modes = mode_path(what, model.initial)
    whole = MessagesUsed(what, model)
    used = whole.used(0, modes)
    lost = whole.lost(0, used, modes)
    for cuts in ([0, 1, 700], [0, 255, 256, 257, 512, 700], [0, 300, 300, 700]):
        parts = MessagesUsed(what, model)
        for first, end in pairwise(cuts):
            now = parts.used(first, modes[first:end])
            assert np.array_equal(now, used[first:end])
            assert np.array_equal(parts.lost(first, now, modes[first:end]), lost[first:end])
