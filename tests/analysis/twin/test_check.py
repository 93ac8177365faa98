"""The comparison with the twin finds what was changed, and says where; with noise and losses on the air, too."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from experiments import Run, check, flipped, line_ring, simulate, stored
from msg_analysis.errors import NotAvailableError
from msg_analysis.twin.check import Check


@pytest.fixture(scope="module")
def twin() -> Run:
    return simulate(line_ring(run={"seed": 5}))


@pytest.fixture(scope="module")
def noisy() -> Run:
    """Values are published with noise, and messages lost."""
    return simulate(line_ring(noise={"broadcast": 0.2, "loss": 0.3}, run={"seed": 5}))


def checked(run: Run, directory: Path, **changes: object) -> Check:
    """Of a bag of the run with these changes."""
    return check(stored(dataclasses.replace(run, **changes), directory))


@pytest.mark.parametrize("kind", ["twin", "noisy"])
def test_equal(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    outcome = checked(request.getfixturevalue(kind), tmp_path)
    assert (outcome.difference, outcome.missing) == (None, 0)
    assert outcome.compared == 401 * 3 * (2 if kind == "noisy" else 1)


def test_external_agents(tmp_path: Path) -> None:
    with pytest.raises(NotAvailableError, match=r"run.external: the states of a run in lockstep follow from those of"):
        checked(simulate(line_ring(run={"external": [2]})), tmp_path)


@pytest.mark.parametrize("where", [(0, 0, 0), (17, 2, 1), (400, 1, 0)])
def test_one_bit(twin: Run, tmp_path: Path, where: tuple[int, int, int]) -> None:
    step, agent, replica = where
    changed = flipped(twin.states, *where)
    assert checked(twin, tmp_path, states=changed).difference == (
        f"agent {agent + 1} at step {step}, replica {replica + 1}: logged {float(changed[where])!r}, "
        f"the law gives {float(twin.states[where])!r}"
    )


def test_the_first_of_several_is_named(twin: Run, tmp_path: Path) -> None:
    changed = flipped(flipped(flipped(twin.states, 30, 0, 1), 29, 2, 0), 29, 1, 1)
    assert checked(twin, tmp_path, states=changed).difference.startswith("agent 2 at step 29, replica 2:")


@pytest.mark.parametrize(
    ("step", "first"), [(40, "agent 1 at step 40"), (41, "graph of step 40: logged {}, the seed gives {}")]
)
def test_wrong_graph_and_state(twin: Run, tmp_path: Path, step: int, first: str) -> None:
    """Whichever came first is named: x(40) is older than the choice of g(40), x(41) comes out of it."""
    modes = twin.modes.copy()
    modes[40:50] = 1 - modes[40:50]
    difference = checked(twin, tmp_path, states=flipped(twin.states, step, 0, 0), modes=modes).difference
    names = [["line", "ring"][one[40]] for one in (modes, twin.modes)]
    assert difference.startswith(first.format(*names))


def test_missing_states_are_counted_and_do_not_differ(twin: Run, noisy: Run, tmp_path: Path) -> None:
    states = twin.states.copy()
    states[100:, 1] = np.nan
    outcome = checked(twin, tmp_path, states=states)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 301, 401 * 3 - 301)
    published, states = noisy.published.copy(), noisy.states.copy()
    published[300:, 1], states[350:, 2] = np.nan, np.nan
    outcome = checked(noisy, tmp_path / "noisy", published=published, states=states)
    assert (outcome.difference, outcome.missing) == (None, 101 + 51)


def test_published(noisy: Run, tmp_path: Path) -> None:
    published = noisy.published.copy()
    published[30, 1, 1] = np.nextafter(published[30, 1, 1], 9.0)
    published[31, 0] += 1.0
    assert checked(noisy, tmp_path, published=published).difference == (
        f"agent 2 at step 30, replica 2: published {float(published[30, 1, 1])!r}, "
        f"the law gives {float(noisy.published[30, 1, 1])!r}"
    )


def test_losses(noisy: Run, tmp_path: Path) -> None:
    """Step 50 leads to x(51). Agent 2 hears agents 1 and 3 in both graphs."""
    lost, states = noisy.lost.copy(), noisy.states.copy()
    lost[50, 1, 1] ^= True
    words = ("heard", "lost") if noisy.lost[50, 1, 1] else ("lost", "heard")
    states[51, 0, 0] += 1.0
    assert checked(noisy, tmp_path, lost=lost, states=states).difference == (
        f"the message of agent 3 to agent 2 in step 50: logged as {words[0]}, the seed gives {words[1]}"
    )
    states[50, 0, 0] += 1.0
    assert checked(noisy, tmp_path / "earlier", lost=lost, states=states).difference.startswith("agent 1 at step 50")
