"""The twin with all that can happen to messages, in both paces: against loops over numbers, from the definitions."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from links_by_hand import assert_by_hand

from experiments import Experiment, Run, check, claimed, line_ring, predict, simulate, stored
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.reception import LOST
from msg_analysis.model.step_model import phases
from msg_analysis.report.documents import describe_transient

BY_LINK = {"default": 0.1, "edges": [[2, 3, 0.6]], "arcs": [[1, 2, 0.0], [2, 1, 0.8]]}
AIRS: dict[str, dict[str, Any]] = {
    "plain": {},
    "noisy": {"broadcast": 0.3, "link": 0.2},
    "own": {"loss": 0.3},
    "hold": {"loss": 0.4, "on_loss": "hold"},
    "bursts": {"loss": 0.3, "burst": 6.0, "link": 0.2},
    "bursts, hold": {"loss": 0.5, "burst": 9.5, "on_loss": "hold", "broadcast": 0.3},
    "even losses": {"loss": 0.45, "burst": 1.0},
    "by link": {"loss": BY_LINK, "on_loss": "hold", "broadcast": 0.3, "link": 0.2},
    "late": {"delay": 3},
    "late and lost": {"delay": 2, "loss": 0.3, "broadcast": 0.3, "link": 0.2},
    "all": {"delay": 2, "loss": BY_LINK, "burst": 7.0, "on_loss": "hold", "broadcast": 0.3, "link": 0.2},
    "later than a block": {"delay": 300, "loss": 0.5, "on_loss": "hold", "link": 0.2},
}
CORRELATED = [[0.5, 0.1, 0.0, 0.0], [0.0, 0.4, 0.0, -0.3], [0.0, 0.0, 0.6, 0.0], [0.2, 0.0, 0.0, 0.5]]
LAWS: dict[str, dict[str, Any]] = {
    "consensus": {"graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"arcs": [[1, 3, 0.5], [4, 1], [2, 4], [2, 1]]}}},
    "correlated": {"process": {"a": CORRELATED, "b": [0.5, 0.1, 0.0, 1.0]}},
    "tracking": {"problem": "tracking", "leaders": {"agents": [2], "gain": 7.0, "reference": 2.5}},
    "grounded": {"problem": "tracking", "leaders": {"agents": [3], "gain": "inf", "reference": -1.0}},
    "noise of grounded leaders by graph": {
        "problem": "tracking",
        "leaders": {"agents": [1], "gain": "inf", "reference": -1.0},
        "process": {"a": 0.3, "b": CORRELATED},
    },
    "discrete": {"time": "discrete"},
    "leaders of discrete time alone heard": {
        "time": "discrete",
        "problem": "tracking",
        "leaders": {"agents": [1], "gain": "inf"},
        "graphs": {"a": {"star": {"center": 1}}, "b": {"star": {"center": 1}}},
    },
    "metropolis": {"protocol": {"name": "metropolis", "laziness": 0.2}},
    "saturated": {"protocol": {"name": "saturated"}},
    "integral_action": {"protocol": {"name": "integral_action"}},
}
PACES = ("lockstep", "realtime")


def four_agents(law: str, air: str, pace: str = "lockstep", **run: Any) -> Experiment:
    document: dict[str, Any] = {
        "name": "links",
        "agents": 4,
        "graphs": {"a": {"path": [1, 2, 3, 4]}, "b": {"edges": [[1, 2, 0.5], [2, 3], [1, 4, 2.0]]}},
        **LAWS[law],
    }
    discrete = document.get("time") == "discrete"
    chain = {"transition": [[0.9, 0.1], [0.3, 0.7]]} if discrete else {"generator": [[-1.0, 1.0], [2.0, -2.0]]}
    dt = 1.0 if discrete else 0.05
    times = {"dt": dt, "duration": 310 * dt, "replicas": 2, "seed": 5, "pace": pace, "start": [1.0, -2.0, 0.5, 3.0]}
    noise = {"process": document.pop("process", 0.5), **AIRS[air]}
    return Experiment.parse(document | {"switching": chain, "noise": noise, "run": times | run})


@functools.cache
def twin(law: str, air: str, pace: str = "lockstep") -> Run:
    """Of the twin; made once for all tests that only look at it."""
    return simulate(four_agents(law, air, pace))


@pytest.mark.parametrize("air", AIRS)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("pace", PACES)
def test_equals_loops_over_numbers_to_the_last_bit(pace: str, law: str, air: str) -> None:
    assert_by_hand(twin(law, air, pace))


@pytest.mark.parametrize("replicas", [1, 3])
@pytest.mark.parametrize("law", ["correlated", "grounded"])
def test_so_do_other_numbers_of_replicas(law: str, replicas: int) -> None:
    assert_by_hand(simulate(four_agents(law, "plain", replicas=replicas)))
    assert_by_hand(simulate(four_agents(law, "by link", replicas=replicas)))


@pytest.mark.parametrize("agents", [3, 7])
def test_so_do_other_numbers_of_agents(agents: int) -> None:
    """Noise and losses are those of the agent and the link, whoever else there is."""
    assert_by_hand(simulate(line_ring(agents, noise=AIRS["late and lost"], run={"start": "zero"})))


@pytest.mark.parametrize("pace", PACES)
def test_a_past_ends_where_the_run_begins(pace: str) -> None:
    """The stationary start, from steps with negative numbers; the messages of a run begin with its x(0)."""
    what = four_agents("consensus", "all", pace, start="stationary")
    trajectory = simulate(what)
    assert_by_hand(trajectory)
    assert not np.array_equal(trajectory.states[0], twin("consensus", "plain", pace).states[0])


@pytest.mark.parametrize("resumed", [0, 1, 255, 256, 300])
@pytest.mark.parametrize(
    ("law", "air"),
    [(law, "plain") for law in LAWS]
    + [(law, air) for law in ("consensus", "integral_action") for air in ("all", "late and lost", "bursts", "hold")],
)
def test_agents_alone_equal_the_whole(law: str, air: str, resumed: int) -> None:
    """Also those that go on from some step, for a hundred steps, and know nothing of what was before."""
    trajectory = twin(law, air)
    published = trajectory.states if trajectory.published is None else trajectory.published
    delay = trajectory.record.experiment.noise.delay
    for i in range(4):
        agent = agent_law(trajectory.record, trajectory.record.model, i)
        if resumed:
            agent.resume(resumed, trajectory.states[resumed, i].tobytes())
        for k, g in list(enumerate(trajectory.modes.tolist()))[resumed : resumed + 100 if resumed else None]:
            assert agent.published(k, agent.state) == published[k, i].tobytes()
            senders = agent.neighbours(g)
            heard = [published[agent.air.needed(j, k) if agent.air else k, j].tobytes() for j in senders]
            assert agent.advance(g, heard) == trajectory.states[k + 1, i].tobytes()
            newest = max(0, k - delay)
            used = [newest] * len(senders)
            if trajectory.used is not None:
                used = trajectory.used[k, i, : len(senders)].tolist()
            elif trajectory.lost is not None:
                used = [-1 if gone else newest for gone in trajectory.lost[k, i, : len(senders)]]
            expected = tuple(LOST if step < 0 else step for step in used)
            assert agent.heard == (() if set(used) <= {newest} else expected)


@pytest.mark.parametrize(
    ("law", "air"), [("consensus", air) for air in AIRS] + [("integral_action", air) for air in ("plain", "own", "all")]
)
@pytest.mark.parametrize("pace", PACES)
def test_bags_keep_all_of_it(pace: str, law: str, air: str, tmp_path: Path) -> None:
    """Written, read and checked; with states of one number, and of two."""
    made = twin(law, air, pace)
    read = stored(made, tmp_path)
    outcome = check(read)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, made.completeness.expected)
    for key in ("states", "published", "lost", "used", "made"):
        np.testing.assert_array_equal(getattr(made, key), getattr(read, key), err_msg=key)
    np.testing.assert_array_equal(read.agent_modes[1:], np.repeat(made.modes[:, None], 4, axis=1))


def test_another_value_than_the_last_one_heard_is_found(tmp_path: Path) -> None:
    made = simulate(four_agents("consensus", "hold"))
    step, agent, which = place = tuple(np.argwhere(made.used > 3)[40].tolist())
    made.used[place] -= 1
    difference = str(check(stored(made, tmp_path)).difference)
    sender = int(made.record.model.neighbours(int(made.modes[step]), agent)[which]) + 1
    assert difference == (
        f"the value of agent {sender} that agent {agent + 1} used in step {step}: logged as that of step "
        f"{made.used[place]}, the seed gives step {made.used[place] + 1}"
    ) or difference.startswith(f"the message of agent {sender} to agent {agent + 1} in step {step}")


def test_lost_messages_that_were_used_in_real_time_are_found() -> None:
    plain, lossy = (four_agents("consensus", air, "realtime") for air in ("plain", "own"))
    assert "which the seed loses" in check(claimed(simulate(plain), lossy)).difference


def test_phases_are_spread_over_the_period() -> None:
    """And states are made at these times, under the graph of the step."""
    trajectory = twin("consensus", "plain", "realtime")
    due = (np.arange(310)[:, None] + phases(trajectory.experiment)) * 5e7
    np.testing.assert_allclose(trajectory.made, np.vstack([np.zeros(4), due]), rtol=0, atol=1)
    assert (trajectory.agent_modes[1:] == trajectory.modes[:, None]).all()
    assert trajectory.completeness.complete
    found = {tuple(phases(four_agents("consensus", "plain", "realtime", seed=seed))) for seed in range(200)}
    assert len(found) == 24  # all orders of four agents
    assert {tuple(sorted(phase)) for phase in found} == {(0.125, 0.375, 0.625, 0.875)}


def test_transients_are_those_of_the_sequential_law() -> None:
    what = four_agents("consensus", "plain", "realtime", start="zero")
    document, steady = describe_transient(what, np.array([0.0, 1.0, 400.0])), predict(what).emulated.system_error
    assert document["steady_system_error"] == pytest.approx(steady)
    assert document["system_error"][2] == pytest.approx(steady)
