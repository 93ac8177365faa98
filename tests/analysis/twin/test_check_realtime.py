"""The replay of a run in real time, against the loop of events of benchmarks/late_timers.py, and agent by agent."""

import dataclasses
import re
from pathlib import Path

import late_timers
import numpy as np
import pytest
from late_timers import busy

from experiments import TRACKING, Run, changed, check, flipped, line_ring, new_record, stored
from msg_analysis.arithmetic.update_law import from_payload, to_payload
from msg_analysis.model.agent_law import agent_law
from msg_analysis.twin.log_replay import replay

CORRELATED = [[0.1 * (1 + i + j) for j in range(4)] for i in range(4)]
REAL_TIME = {"seed": 5, "pace": "realtime"}
LAW = line_ring(4, noise={"process": {"line": [1, 2, 0, 0.5], "ring": CORRELATED}}, run=REAL_TIME, **TRACKING)


@pytest.fixture(scope="module")
def late() -> Run:
    """Agents step late by chance, hear late by chance, learn of the graph late by chance."""
    return late_timers.run(LAW, late=busy(0.1, 3.0), slow=busy(0.9, 0.1), switch=busy(0.5, 0.4))


def differing(late: Run, directory: Path, **changes: object) -> str:
    """The difference from the law that is found in a bag of a run with these changes."""
    return str(check(stored(dataclasses.replace(late, **changes), directory)).difference)


def test_equal(late: Run, tmp_path: Path) -> None:
    assert (late.agent_modes[1:] != late.modes[:, None]).any()
    outcome = check(stored(late, tmp_path))
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, 4 * 401)


@pytest.mark.parametrize("step", [0, 1, 300, 400])
def test_the_last_bit(late: Run, tmp_path: Path, step: int) -> None:
    states = flipped(late.states, step, 2, 1)
    assert differing(late, tmp_path, states=states) == (
        f"agent 3 at step {step}, replica 2: logged {float(states[step, 2, 1])!r}, "
        f"the law gives {float(late.states[step, 2, 1])!r}"
    )


@pytest.mark.parametrize(("agent", "found"), [(2, None), (1, "agent 2 at step 400, replica 2: logged")])
def test_external_agents(late: Run, tmp_path: Path, agent: int, found: str | None) -> None:
    """What they do is theirs, what the others do is not. Nobody has heard of the last step."""
    record = dataclasses.replace(late.record, experiment=LAW.with_run(external=[3]))
    states = flipped(late.states, 400, agent, 1)
    outcome = check(stored(dataclasses.replace(late, record=record, states=states), tmp_path))
    assert (outcome.missing, outcome.compared) == (0, 3 * 401)
    assert outcome.difference is found if found is None else str(outcome.difference).startswith(found)


def test_something_else_used(late: Run, tmp_path: Path) -> None:
    used = late.used.copy()
    used[200, 1, 0] -= 1
    assert differing(late, tmp_path, used=used).startswith("agent 2 at step 201, replica 1: logged")


def test_used_before_it_was_made(late: Run, tmp_path: Path) -> None:
    """By agent 2, who hears agent 1 in both graphs, at least."""
    made = late.made.copy()
    sent = late.used[200, 1, 0]
    made[sent, 0] = made[201, 1]
    words = r"agent \d at step \d+: stamped [\d.]+ s of simulated time, "
    words += rf"and used step {sent} of agent 1, stamped {made[sent, 0] / 1e9} s"
    assert re.fullmatch(words, differing(late, tmp_path, made=made))


def test_another_graph(late: Run, tmp_path: Path) -> None:
    modes = late.modes.copy()
    modes[100:] = 1 - modes[100:]
    assert differing(late, tmp_path, modes=modes).startswith("graph of step 100: logged ")


def test_gaps(late: Run, tmp_path: Path) -> None:
    """What cannot be computed for want of something is missing, not different; what comes after it is checked."""
    states = late.states.copy()
    states[50, 1] = np.nan
    outcome = check(stored(dataclasses.replace(late, states=states), tmp_path))
    assert outcome.difference is None
    assert 2 <= outcome.missing < 30
    states[60:] = flipped(states, 390, 3, 0)[60:]
    assert differing(late, tmp_path / "again", states=states).startswith("agent 4 at step 390, replica 1")


def test_each_step_is_that_of_the_agent(late: Run) -> None:
    """Whatever was logged: any states, graphs and values used, old or lost, some missing, with noise on the air."""
    noise = {"process": 1.0, "broadcast": 0.2, "link": 0.3, "loss": 0.2}
    record = new_record(changed(LAW, noise=noise))
    random, (count, m, replicas) = np.random.default_rng(7), late.states.shape
    states, published = random.normal(size=(2, count, m, replicas))
    states[random.random((count, m)) < 0.05] = np.nan
    published[random.random((count, m)) < 0.05] = np.nan
    graphs = random.integers(-1, 2, (count, m))
    used = np.arange(count - 1)[:, None, None] - random.geometric(0.3, late.used.shape)
    used = np.where(random.random(used.shape) < 0.1, -1, np.maximum(used, -1))
    log = dataclasses.replace(late, record=record, states=states, published=published, agent_modes=graphs, used=used)
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
