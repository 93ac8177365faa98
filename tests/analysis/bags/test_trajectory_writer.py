"""Trajectories as bags: what is written, in which order, and what a failure leaves."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from full_disk import full_disk
from mcap.reader import make_reader

from experiments import Completeness, Run, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags.writing import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.messages.topics import network_topics

MakeRun = Callable[..., Run]


def test_what_is_missing_stays_missing(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    run.states[7, 1] = np.nan
    run.modes[10:12] = -1
    count = Completeness(expected=123, received=122, missing=1, missing_modes=2)
    write_trajectory(Run(run.record, run.states, run.modes, count), tmp_path / "bag")
    found = read_bag(tmp_path / "bag")
    assert found.record.to_json() == run.record.to_json()
    assert np.array_equal(found.states, run.states, equal_nan=True)
    assert np.array_equal(found.modes, run.modes)
    assert found.completeness == count


def test_a_failed_store_leaves_nothing(tmp_path: Path, make_run: MakeRun) -> None:
    with full_disk(5000), pytest.raises(BagError, match="free some space"):
        write_trajectory(make_run(), tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="exists already"):
        write_trajectory(make_run(), tmp_path / "bag")
    assert list((tmp_path / "bag").iterdir()) == []


def test_run_record_survives_in_the_metadata(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    bag = BagWriter(tmp_path / "bag", network_topics(3), record=run.record.to_json())
    bag.flush()
    found = read_bag(tmp_path / "bag")  # nothing came before the recorder died
    assert found.record.run == run.record.run
    assert found.completeness.missing == found.completeness.expected
    bag.close(complete=False)


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_the_order_of_messages(tmp_path: Path, pace: str) -> None:
    """By time, then by step and agent, however late an agent is; the same bytes where few steps are sorted at once."""
    run = simulate(line_ring(noise={"broadcast": 0.1}, run={"dt": 0.1, "duration": 12, "pace": pace}))
    if run.made is not None:
        random = np.random.default_rng(2)
        late = random.exponential(4e8, (121, 3)) * (random.random((121, 3)) < 0.2)
        made = np.maximum.accumulate(run.made + late.astype(np.int64), axis=0) // 50_000_000 * 50_000_000
        made[0] = 0
        made[70, 1] = -1
        for values in (run.states, run.published):
            values[70, 1] = np.nan
        run = dataclasses.replace(run, made=made)
    write_trajectory(run, tmp_path / "whole" / "bag")
    write_trajectory(run, tmp_path / "parts" / "bag", block_numbers=20)
    files = [tmp_path / name / "bag" / "bag_0.mcap" for name in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    times = run.made if run.made is not None else np.repeat(np.arange(121)[:, None] * 100_000_000, 3, axis=1)
    cells = sorted((int(times[k, i]), k, i) for k, i in np.ndindex(121, 3) if (k, i) != (70, 1) or pace == "lockstep")
    expected = [(f"/agent_{i + 1}/truth", time) for time, _, i in cells]
    with files[0].open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=False))
    found = [(channel.topic, message.log_time) for _, channel, message in messages if channel.topic.endswith("/truth")]
    assert found == expected
