"""Long runs: in files, and block after block, with memory for one block."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.common import arrays
from msg_analysis.common.arrays import in_file
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.verdict import compare
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.reception import MessagesUsed
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import new_record, simulate

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


def experiment(case: str, steps: int, replicas: int = 2) -> Experiment:
    changes = RUNS[case]
    document: dict[str, Any] = {
        "name": "long",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
    }
    run = {"dt": 0.05, "duration": 0.05 * steps, "replicas": replicas, "seed": 5} | changes.get("run", {})
    return Experiment.parse(document | changes | {"run": run})


@pytest.mark.parametrize("case", RUNS)
def test_the_same_in_files(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twin, bag and check; a bit that is turned over behind two blocks of steps is found."""
    what = experiment(case, 600)
    twin = simulate(what)
    monkeypatch.setattr(arrays, "LARGE", 1)
    again = simulate(what, record=twin.record)
    for name in ("states", "published", "lost", "used", "made", "agent_modes"):
        one, other = getattr(twin, name), getattr(again, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert in_file(other)
            assert not in_file(one)
            assert np.array_equal(one, other), name
    write_trajectory(again, tmp_path / "bag")
    assert check(read_bag(tmp_path / "bag")).difference is None
    changed = twin.states.copy()
    changed.view(np.uint64)[551, 3, 1] ^= np.uint64(1)
    write_trajectory(dataclasses.replace(twin, states=changed), tmp_path / "changed")
    outcome = check(read_bag(tmp_path / "changed"))
    assert outcome.difference is not None
    assert outcome.difference.startswith("agent 4 at step 551, replica 2: ")


@pytest.mark.parametrize("case", ["held", "noisy", "real time", "protocol"])
def test_check_needs_memory_for_a_block(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the steps need hardly more memory: 8 bytes of each step for its graph, and as much for a copy."""
    monkeypatch.setattr(arrays, "LARGE", 1)
    runs = [simulate(experiment(case, steps)) for steps in (768, 1_280)]
    short, long = (_peak(lambda run=run: check(run)) for run in runs)
    assert long - short < 512 * 32


@pytest.mark.parametrize("case", ["real time", "protocol in real time"])
def test_comparison_needs_memory_for_a_block(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the steps need at most some numbers more for each; its states alone have 320 bytes."""
    monkeypatch.setattr(arrays, "LARGE", 1)
    for place in ("observed.observation.BLOCK_NUMBERS", "observed.measurement.BLOCK_NUMBERS"):
        monkeypatch.setattr(f"msg_analysis.inference.{place}", 4_000)
    monkeypatch.setattr("msg_analysis.inference.given_path.SMALL_BLOCK", 4_000)
    monkeypatch.setattr("msg_analysis.inference.pattern_events.CACHED_NUMBERS", 4_000)
    runs = [simulate(experiment(case, steps, replicas=8)) for steps in (200, 400)]
    for run in runs:  # what is kept for comparisons to come
        compare(run)
    short, long = (_peak(lambda run=run: compare(run)) for run in runs)
    assert long - short < 200 * 160


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
    what = experiment(case, 700)
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
