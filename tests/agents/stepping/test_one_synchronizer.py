"""One agent in lockstep, step by step: what it refuses, what it waits for, and what it lacks."""

from __future__ import annotations

import copy

import pytest

from msg_agents.stepping.synchronizer import LOCKSTEP_WINDOW, RESEND_LIMIT, Synchronizer
from msg_analysis.messages.acceptance import Refusal


def make_step(node: Synchronizer[str]) -> tuple[int, list[str]]:
    """What the step that is ready uses."""
    assert node.ready()
    taken = node.inputs()
    node.advance()
    return taken


def pair(window: int = 2, steps: int = 10) -> Synchronizer[str]:
    """Agent 1 of a pair with a third one around who is never heard."""
    return Synchronizer(agent=0, steps=steps, inputs=[[1], []], peers=[1], window=window)


def everything(node: Synchronizer[str]) -> object:
    return copy.deepcopy({key: value for key, value in vars(node).items() if key != "_limit"})


@pytest.mark.parametrize(
    ("agent", "step", "reason"),
    [
        (2, 0, Refusal.NOT_A_PEER),
        (0, 0, Refusal.NOT_A_PEER),
        (-1, 0, Refusal.NOT_A_PEER),
        (1, 0, Refusal.CONTRADICTION),
        (1, 1, Refusal.CONTRADICTION),
        (1, 5, Refusal.TOO_NEW),
        (1, 2**64 - 1, Refusal.TOO_NEW),
    ],
)
def test_refused_states_change_nothing(agent: int, step: int, reason: str) -> None:
    node = pair()
    node.learn(0, 0, 0, 9)
    assert node.offer(1, 0, "zero") is None
    assert make_step(node) == (0, ["zero"])
    assert node.offer(1, 1, "one") is None
    before = everything(node)
    assert node.offer(agent, step, "forged") == reason
    assert everything(node) == before
    assert [node.offer(1, 0, "zero"), node.offer(1, 1, "one")] == [Refusal.REPEATED] * 2  # the true ones again
    assert everything(node) == before
    assert make_step(node) == (0, ["one"])


def test_another_value_is_noticed_for_as_long_as_the_true_one_can_take() -> None:
    """Whoever forges a message is heard first and used; the true one comes at most a window of steps later."""
    node = pair(window=LOCKSTEP_WINDOW, steps=10 * LOCKSTEP_WINDOW)
    node.learn(0, 0, 0, 10 * LOCKSTEP_WINDOW - 1)
    for k in range(2 * LOCKSTEP_WINDOW):
        assert node.offer(1, k, f"{k}") is None
        make_step(node)
    assert node.offer(1, LOCKSTEP_WINDOW, "forged") == Refusal.CONTRADICTION
    assert node.offer(1, LOCKSTEP_WINDOW - 1, "forged") == Refusal.REPEATED
    assert node.buffered == 0


def test_whose_states_are_lacking() -> None:
    """Those that the next step needs, and those that are too far behind; before the graph is known only these."""
    node: Synchronizer[str] = Synchronizer(agent=0, steps=9, inputs=[[1, 2], [2], []], peers=[1, 2, 4], window=1)
    assert node.lacking() == []
    node.learn(0, 0, 0, 0)
    assert node.lacking() == [1, 2]
    node.offer(1, 0, "0")
    assert node.lacking() == [2]
    node.offer(2, 0, "0")
    node.learn(1, 2, 1, 8)  # nobody is heard
    make_step(node)
    assert not node.ready()
    assert node.lacking() == [4]  # which has not begun


def test_what_is_long_past_is_no_repetition() -> None:
    node: Synchronizer[str] = Synchronizer(
        agent=0, steps=10**6, inputs=[[1]], peers=[1], start=RESEND_LIMIT + 100, window=LOCKSTEP_WINDOW
    )
    assert node.offer(1, RESEND_LIMIT + 100, "now") is None
    assert node.offer(1, 100 - LOCKSTEP_WINDOW, "the oldest that is sent again") == Refusal.REPEATED
    assert node.offer(1, 99 - LOCKSTEP_WINDOW, "forged") == Refusal.TOO_OLD


@pytest.mark.parametrize(
    ("sequence", "first", "last", "reason"),
    [
        (0, 0, 4, Refusal.REPEATED),
        (2, 5, 9, Refusal.OUT_OF_SEQUENCE),
        (1, 6, 9, Refusal.OUT_OF_SEQUENCE),
        (1, 4, 9, Refusal.OUT_OF_SEQUENCE),
        (1, 5, 4, Refusal.OUT_OF_SEQUENCE),
    ],
    ids=["again", "one left out", "gap", "overlap", "empty"],
)
def test_refused_sojourns_change_nothing(sequence: int, first: int, last: int, reason: str) -> None:
    node = pair()
    assert node.learn(0, 0, 0, 4) is None
    before = everything(node)
    assert node.learn(sequence, 1, first, last) == reason
    assert everything(node) == before
    assert node.learn(1, 1, 5, 9) is None


def test_the_farthest_possible_step_is_taken() -> None:
    node = pair(window=2)
    assert [node.offer(1, k, str(k)) for k in range(4)] == [None] * 4
    assert node.buffered == 4
    assert node.offer(1, 4, "4") == Refusal.TOO_NEW


def test_a_peer_without_a_link_still_holds_back() -> None:
    node = pair(window=1)
    node.learn(0, 1, 0, 9)  # a graph in which nobody is heard
    make_step(node)  # with nothing heard: x(1) is one step ahead of a peer that has not even begun
    assert not node.ready()
    assert node.waiting_for() == "too far behind: agent 2"
    assert node.offer(1, 0, "0") is None  # of no use any more, but it shows that the peer moves
    assert node.offer(1, 0, "0") == Refusal.REPEATED
    assert node.ready()
    assert node.buffered == 0


def test_alone() -> None:
    node: Synchronizer[str] = Synchronizer(agent=0, steps=3, inputs=[[]], peers=[], window=0)
    node.learn(0, 0, 0, 2)
    assert [make_step(node) for _ in range(3)] == [(0, [])] * 3
    assert node.finished
    assert not node.ready()


def test_waiting_for() -> None:
    node: Synchronizer[str] = Synchronizer(agent=1, steps=1, inputs=[[0, 2]], peers=[0, 2], window=3)
    assert node.waiting_for() == "the graph of step 0"
    assert node.awaits_graph
    node.learn(0, 0, 0, 0)
    assert not node.awaits_graph
    assert node.waiting_for() == "step 0 of agent 1, agent 3"
    node.offer(0, 0, "a")
    assert node.waiting_for() == "step 0 of agent 3"
    node.offer(2, 0, "c")
    assert node.waiting_for() == "nothing"
    make_step(node)
    assert node.waiting_for() == "nothing, it has finished"
    assert not node.awaits_graph


def test_inputs_must_be_peers() -> None:
    with pytest.raises(ValueError, match=r"uses \[3\]"):
        Synchronizer(agent=0, steps=1, inputs=[[1, 3]], peers=[1])
