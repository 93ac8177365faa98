"""Reading the states of a running network out of its agents' checkpoints: what was written, whole, each once."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import experiment

from msg_agents.recovery import Checkpoint, entry_size
from msg_agents.watch.observer import BLOCK, CheckpointReader, EarlyEnd, RunObserver
from msg_analysis.arithmetic.update_law import to_payload
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.online_steps import StateLog
from msg_analysis.inference.pool import compare
from msg_analysis.messages.messages import StateCodec
from msg_analysis.messages.topics import agent_node_name
from msg_analysis.model.reception import LOST, neighbour_tables
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord, Until
from msg_analysis.twin.simulate import simulate


def _experiment(duration: float = 20, **changes: Any) -> Experiment:
    return experiment(3, run={"duration": duration, "seed": 3}, **changes)


class Writers:
    """Writes a trajectory as the agents would, up to any step."""

    def __init__(self, trajectory: Run, directory: Path) -> None:
        self.record: RunRecord = trajectory.record
        what, run = self.record.experiment, self.record.run.bytes
        size = entry_size(self.record)
        self._trajectory, self._done = trajectory, -1
        self._files = [Checkpoint(directory / f"{agent_node_name(i)}.states", size) for i in range(what.agents)]
        self._codecs = [StateCodec(run, i + 1, what.width, what.step_length) for i in range(what.agents)]

    def write(self, last: int) -> None:
        lossy = self.record.experiment.noise.loss.any
        for step in range(self._done + 1, last + 1):
            mode = int(self._trajectory.modes[step - 1]) + 1 if step else 0
            for agent, (file, codec) in enumerate(zip(self._files, self._codecs, strict=True)):
                heard = []
                if lossy and step:
                    lost = self._trajectory.lost[step - 1, agent]
                    count = len(self.record.model.neighbours(mode - 1, agent))
                    heard = [LOST if each else step - 1 for each in lost[:count]] if lost.any() else []
                payload = to_payload(np.ascontiguousarray(self._trajectory.states[step, agent]))
                published = self._trajectory.published
                value = b"" if published is None else to_payload(np.ascontiguousarray(published[step, agent]))
                file.write(step, codec.wrap(step, mode, payload, heard) + value)
        self._done = last


@pytest.mark.parametrize("noise", [{}, {"loss": 0.1}, {"broadcast": 0.2}, {"loss": 0.1, "broadcast": 0.2}])
def test_gives_what_was_written(tmp_path: Path, noise: dict[str, float]) -> None:
    """Steps with what was published and lost of them, where that is more than the states."""
    trajectory = simulate(_experiment(noise={"process": 1.0, **noise}))
    reader = CheckpointReader(trajectory.record, tmp_path)
    reader.keep(StateLog(trajectory.record))
    assert not reader.ready()
    writers = Writers(trajectory, tmp_path)
    assert reader.ready()
    assert not len(reader.take(-1)[0])
    seen, logs = [], []
    for last in (0, 1, 2, 150, 150, 400):
        writers.write(last)
        steps, modes, states, after = reader.take(last)
        seen += steps.tolist()
        assert np.array_equal(modes, trajectory.modes[steps])
        assert np.array_equal(states, trajectory.states[steps])
        assert np.array_equal(after, trajectory.states[steps + 1])
        logs += [(steps, reader.logged)] if len(steps) else []
    assert seen == list(range(400))
    assert reader.missed == 0
    for steps, logged in logs:
        assert logged.steps.tolist() == [*steps.tolist(), steps[-1] + 1]
        assert np.array_equal(logged.states, trajectory.states[logged.steps])
        assert_same(logged.published, trajectory.published, logged.steps)
        lost = None if trajectory.lost is None else trajectory.lost | (neighbour_counts(trajectory) <= 0)
        assert_same(None if lost is None else logged.used[1:] < 0, lost, steps)


def assert_same(found: np.ndarray | None, wanted: np.ndarray | None, steps: np.ndarray) -> None:
    """Both are there at these steps and equal, or none is there."""
    assert (found is None) == (wanted is None)
    assert wanted is None or np.array_equal(found, wanted[steps])


def neighbour_counts(trajectory: Run) -> np.ndarray:
    """(N, m, D): how many neighbours are left from the d-th on, in the graph of the step."""
    tables = neighbour_tables(trajectory.record.model)
    return tables.count[trajectory.modes][:, :, None] - np.arange(trajectory.record.model.most_neighbours)


def test_what_was_written_over_is_missed(tmp_path: Path) -> None:
    """The ring has room for 6000 steps; half of that is read, so that nothing is read while it is written over."""
    trajectory = simulate(_experiment(duration=500))
    writers = Writers(trajectory, tmp_path)
    reader = CheckpointReader(trajectory.record, tmp_path)
    writers.write(100)
    assert reader.ready()
    assert reader.take(100)[0].tolist() == list(range(100))
    writers.write(9000)
    seen = []
    while len(found := reader.take(9000)[0]):
        assert len(found) <= BLOCK
        seen += found.tolist()
    assert seen == list(range(6000, 9000))
    assert reader.missed == 5900


def test_half_written_states_do_not_count(tmp_path: Path) -> None:
    trajectory = simulate(_experiment())
    writers = Writers(trajectory, tmp_path)
    writers.write(50)
    path = tmp_path / "agent_2.states"
    size = entry_size(trajectory.record)
    data = bytearray(path.read_bytes())
    data[20 * (size + 16) + size + 8 : 20 * (size + 16) + size + 16] = bytes(8)  # the mark of step 20
    path.write_bytes(data)
    reader = CheckpointReader(trajectory.record, tmp_path)
    assert reader.ready()
    steps = reader.take(50)[0].tolist()
    assert steps == [k for k in range(50) if k not in (19, 20)]  # a step needs the state after it, too
    assert reader.missed == 2


def test_the_observer_has_the_numbers_of_the_comparison(tmp_path: Path) -> None:
    trajectory = simulate(_experiment())
    writers = Writers(trajectory, tmp_path)
    observer = RunObserver(trajectory.record, tmp_path)
    writers.write(400)
    observer.look(400)
    observer.end()
    assert observer.note is None
    wanted = compare(trajectory)
    found = observer.report.system
    assert (found.measured, found.predicted, found.standard_error) == pytest.approx(
        (wanted.system_error.measured, wanted.system_error.predicted, wanted.system_error.standard_error), rel=1e-9
    )
    for node, other in zip(observer.report.nodes, wanted.node_errors, strict=True):
        assert (node.measured, node.z) == pytest.approx((other.measured, other.z), rel=1e-6)
    recent = observer.report.recent
    steps = range(400 - len(recent.steps), 400)
    assert len(steps) > 100
    assert (recent.steps.tolist(), recent.modes.tolist()) == ([*steps], trajectory.modes[steps].tolist())
    assert np.array_equal(recent.states, trajectory.states[steps, :, 0])


def test_stamps(tmp_path: Path) -> None:
    """Of the steps that the slots hold; the others have none."""
    trajectory = simulate(_experiment())
    writers = Writers(trajectory, tmp_path)
    writers.write(50)
    reader = CheckpointReader(trajectory.record, tmp_path)
    assert reader.ready()
    steps = np.array([0, 7, 50, 51])
    wanted = [[0] * 3, [350_000_000] * 3, [2_500_000_000] * 3, [-1] * 3]  # dt = 0.05, in ns
    assert reader.stamps(steps).tolist() == wanted


def test_of_an_observer_that_fails_a_run_says_so_once(tmp_path: Path) -> None:
    record = dataclasses.replace(simulate(_experiment()).record, until=Until(0.5))
    ending, notes = EarlyEnd(record, tmp_path), list[str]()
    ending.observer.note = "the errors cannot be followed any more"
    assert [ending.look(step, notes.append) for step in (1, 2)] == [False, False]
    assert notes == [
        f"--until {record.until}: {ending.observer.note}: the run goes on to step {record.experiment.steps}"
    ]
