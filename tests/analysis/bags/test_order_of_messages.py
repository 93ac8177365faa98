"""In which order a trajectory is written."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from msg_analysis.bags import writing
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.simulate import simulate


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_the_order_of_messages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pace: str) -> None:
    """By time, then by step and agent, however late an agent is; the same bytes where few steps are sorted at once."""
    document = {
        "name": "order",
        "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
        "noise": {"broadcast": 0.1},
        "run": {"dt": 0.1, "duration": 12, "replicas": 2, "pace": pace},
    }
    run = simulate(Experiment.parse(document))
    if run.made is not None:
        random = np.random.default_rng(2)
        late = random.exponential(4e8, (121, 3)) * (random.random((121, 3)) < 0.2)
        made = np.maximum.accumulate(run.made + late.astype(np.int64), axis=0) // 50_000_000 * 50_000_000
        made[0] = 0
        made[70, 1] = -1
        for values in (run.states, run.published):
            assert values is not None
            values[70, 1] = np.nan
        run = dataclasses.replace(run, made=made)
    write_trajectory(run, tmp_path / "whole" / "bag")
    monkeypatch.setattr(writing, "BLOCK_NUMBERS", 20)
    write_trajectory(run, tmp_path / "parts" / "bag")
    files = [tmp_path / name / "bag" / "bag_0.mcap" for name in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    times = run.made if run.made is not None else np.repeat(np.arange(121)[:, None] * 100_000_000, 3, axis=1)
    cells = sorted((int(times[k, i]), k, i) for k, i in np.ndindex(121, 3) if (k, i) != (70, 1) or pace == "lockstep")
    expected = [(f"/agent_{i + 1}/truth", time) for time, _, i in cells]
    with files[0].open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=False))
    found = [(channel.topic, message.log_time) for _, channel, message in messages if channel.topic.endswith("/truth")]
    assert found == expected
