"""The replay of a run in real time, against a little loop of events that knows everything."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import Completeness, Experiment, Run, check, flipped, new_record, stored
from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK
from msg_analysis.arithmetic.update_law import from_payload, to_payload
from msg_analysis.model.agent_law import ProcessNoise, agent_law
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.step_model import build_step_model, phases
from msg_analysis.twin.log_replay import replay

DT = 50_000_000  # ns

DOCUMENT: dict[str, Any] = {
    "name": "checked",
    "problem": "tracking",
    "graphs": {"line": {"path": [1, 2, 3, 4]}, "ring": {"cycle": [1, 2, 3, 4]}},
    "switching": {"generator": [[-1, 1], [1, -1]]},
    "leaders": {"agents": [1], "gain": 0.7, "reference": 2.0},
    "noise": {"process": {"line": [1, 2, 0, 0.5], "ring": [[0.1 * (1 + i + j) for j in range(4)] for i in range(4)]}},
    "run": {"dt": 0.05, "duration": 20, "replicas": 2, "seed": 5, "pace": "realtime"},
}


def emulate(experiment: Experiment, seed: int) -> Run:
    """Agents step late by chance, hear late by chance, learn of the graph late by chance."""
    record, model = new_record(experiment), build_step_model(experiment)
    modes = mode_path(experiment, model.initial)
    noise = ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas)
    rng = np.random.default_rng(seed)
    steps, agents = experiment.steps, experiment.agents
    due = (np.arange(steps)[:, None] + phases(experiment)) * DT
    late = np.where(rng.random(due.shape) < 0.1, 3 * DT, DT / 50) * rng.exponential(size=due.shape)
    made = np.zeros((steps + 1, agents), dtype=np.int64)
    made[1:] = np.maximum.accumulate(due + late, axis=0) + np.arange(1, steps + 1)[:, None]
    delay = rng.exponential(DT / 10, (steps + 1, agents))  # until others have it
    states = np.full((steps + 1, *record.start.shape), np.nan)
    states[0] = record.start
    used = np.full((steps, agents, model.most_neighbours), -1)
    agent_modes = np.full((steps + 1, agents), -1)
    for event in np.argsort(made[1:], axis=None, kind="stable"):
        k, i = divmod(int(event), agents)
        now = made[k + 1, i]
        mode = int(modes[min(steps - 1, max(0, int((now - rng.exponential(DT / 5)) // DT)))])
        agent_modes[k + 1, i] = mode
        total = np.zeros(0)
        neighbours = 0
        for j in model.inputs(mode, i).tolist():
            value = states[k, i]
            if j != i:
                there = np.flatnonzero(made[:, j] + delay[:, j] < now)
                if there.size:
                    used[k, i, neighbours] = there[-1]
                    value = states[there[-1], j]
                neighbours += 1
            term = value * model.nominal[mode, i, j]
            total = total + term if total.size else term
        drive = noise.block(i, k // STEPS_PER_BLOCK)[mode][k % STEPS_PER_BLOCK] + model.offsets[mode, i]
        states[k + 1, i] = total + drive
    count = (steps + 1) * agents
    return Run(record, states, modes, Completeness(count, count, 0), agent_modes, used=used, made=made)


@pytest.fixture(scope="module")
def run() -> Run:
    return emulate(Experiment.parse(DOCUMENT), 1)


def test_equal(run: Run, tmp_path: Path) -> None:
    assert (run.agent_modes[1:] != run.modes[:, None]).any()
    outcome = check(stored(run, tmp_path))
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, 4 * 401)


@pytest.mark.parametrize("step", [0, 1, 300, 400])
def test_the_last_bit(run: Run, tmp_path: Path, step: int) -> None:
    states = flipped(run.states, step, 2, 1)
    difference = check(stored(dataclasses.replace(run, states=states), tmp_path)).difference
    assert difference == (
        f"agent 3 at step {step}, replica 2: logged {float(states[step, 2, 1])!r}, "
        f"the law gives {float(run.states[step, 2, 1])!r}"
    )


def test_something_else_used(run: Run, tmp_path: Path) -> None:
    used = run.used.copy()
    used[200, 1, 0] -= 1
    difference = check(stored(dataclasses.replace(run, used=used), tmp_path)).difference
    assert difference.startswith("agent 2 at step 201, replica 1: logged")


def test_used_before_it_was_made(run: Run, tmp_path: Path) -> None:
    """By agent 2, who hears agent 1 in both graphs, at least."""
    made = run.made.copy()
    sent = run.used[200, 1, 0]
    made[sent, 0] = made[201, 1]
    difference = check(stored(dataclasses.replace(run, made=made), tmp_path)).difference
    assert difference is not None
    assert re.fullmatch(
        r"agent \d at step \d+: stamped [\d.]+ s of simulated time, and used "
        rf"step {sent} of agent 1, stamped {made[sent, 0] / 1e9} s",
        difference,
    )


def test_another_graph(run: Run, tmp_path: Path) -> None:
    modes = run.modes.copy()
    modes[100:] = 1 - modes[100:]
    difference = check(stored(dataclasses.replace(run, modes=modes), tmp_path)).difference
    assert difference.startswith("graph of step 100: logged ")


def test_gaps(run: Run, tmp_path: Path) -> None:
    """What cannot be computed for want of something is missing, not different; what comes after it is checked."""
    states = run.states.copy()
    states[50, 1] = np.nan
    outcome = check(stored(dataclasses.replace(run, states=states), tmp_path))
    assert outcome.difference is None
    assert 2 <= outcome.missing < 30
    states[60:] = flipped(states, 390, 3, 0)[60:]
    difference = check(stored(dataclasses.replace(run, states=states), tmp_path / "again")).difference
    assert difference.startswith("agent 4 at step 390, replica 1")


def test_each_step_is_that_of_the_agent(run: Run) -> None:
    """Whatever was logged: any states, graphs and values used, old or lost, some missing, with noise on the air."""
    noise = {"process": 1.0, "broadcast": 0.2, "link": 0.3, "loss": 0.2}
    record = new_record(Experiment.parse(DOCUMENT | {"noise": noise}))
    random, (count, m, replicas) = np.random.default_rng(7), run.states.shape
    states, published = random.normal(size=(2, count, m, replicas))
    states[random.random((count, m)) < 0.05] = np.nan
    published[random.random((count, m)) < 0.05] = np.nan
    graphs = random.integers(-1, 2, (count, m))
    used = np.arange(count - 1)[:, None, None] - random.geometric(0.3, run.used.shape)
    used = np.where(random.random(used.shape) < 0.1, -1, np.maximum(used, -1))
    log = dataclasses.replace(run, record=record, states=states, published=published, agent_modes=graphs, used=used)
    blocks = list(replay(log))
    found = np.concatenate([block.states for block in blocks])
    said = np.concatenate([block.published for block in blocks if block.published is not None])
    assert [block.first for block in blocks] == [0, 256, 400]
    assert np.array_equal(found[0], record.start)
    compared = 0
    for i in range(m):
        law = agent_law(record, record.model, i)
        for k in range(count):
            wanted = from_payload(law.published(k, to_payload(states[k, i])))  # NaN of NaN
            assert np.array_equal(said[k, i], wanted, equal_nan=True)
        for k in range(count - 1):
            mode = int(graphs[k + 1, i])
            senders, steps = law.neighbours(mode), used[k, i, : len(law.neighbours(mode))].tolist()
            heard = [published[step, j] for step, j in zip(steps, senders, strict=True)]
            inputs = [states[k, i], *(value for value, step in zip(heard, steps, strict=True) if step >= 0)]
            wanted = np.full_like(found[k + 1, i], np.nan)
            if mode >= 0 and not np.isnan(inputs).any():
                law.resume(k, to_payload(states[k, i]))
                wanted = from_payload(law.advance(mode, [to_payload(value) for value in heard], steps))
                compared += 1
            assert np.array_equal(found[k + 1, i], wanted, equal_nan=True), (k, i)
    assert compared > 700
