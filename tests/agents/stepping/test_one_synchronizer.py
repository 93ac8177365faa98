"""One agent in lockstep, step by step: what it refuses, what it waits for, what it lacks; turns of several agents."""

import copy
from collections.abc import Callable

import pytest

from msg_agents.stepping.synchronizer import LOCKSTEP_WINDOW, TURN_SLICE, Synchronizer, TurnQueue
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
    return copy.deepcopy({key: value for key, value in vars(node).items() if key not in ("_limit", "_uses", "_needed")})


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
    """A window and 6000 steps ago, which are sent again at most."""
    node: Synchronizer[str] = Synchronizer(agent=0, steps=10**6, inputs=[[1]], peers=[1], start=6_100)
    assert node.offer(1, 6_100, "now") is None
    assert node.offer(1, 36, "the oldest that is sent again") == Refusal.REPEATED
    assert node.offer(1, 35, "forged") == Refusal.TOO_OLD


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
    assert node.learn(1, 0, 0, 4) == Refusal.OUT_OF_SEQUENCE
    assert node.learn(0, 0, 0, 4) is None
    before = everything(node)
    assert node.learn(sequence, 1, first, last) == reason
    assert everything(node) == before
    assert node.learn(1, 1, 5, 9) is None


def test_the_farthest_possible_step_is_taken() -> None:
    node = pair(window=2)
    assert [node.offer(1, k, str(k)) for k in range(4)] == [None] * 4
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


def lonely(held: int) -> Synchronizer[str]:
    """Agent 0 at step 200, which hears agent 1, of which it holds the value of a step."""
    node: Synchronizer[str] = Synchronizer(
        needed=lambda _j, k: held if k <= 200 else k, delay=0, agent=0, steps=300, inputs=[[1]], peers=[1], start=200
    )
    assert node.learn(0, 0, 0, 299) is None
    return node


@pytest.mark.parametrize("held", [90, 150, 200])
def test_it_waits_for_the_value_that_it_holds(held: int) -> None:
    """Newer and older ones do not help; what comes twice must be the same."""
    node = lonely(held)
    assert node.waiting_for() == f"step {held} of agent 2"
    assert node.lacking() == [1]
    assert node.offer(1, 201, "new") is None
    assert node.offer(1, held - 1, "old") == Refusal.REPEATED
    assert not node.ready()
    assert node.offer(1, held, "held") is None
    assert node.offer(1, held, "held") == Refusal.REPEATED
    assert node.offer(1, held, "forged") == Refusal.CONTRADICTION
    assert node.known(1, held) == "held"
    assert node.ready()
    assert node.inputs() == (0, ["held"])
    node.advance()
    assert node.inputs() == (0, ["new"])


def test_values_of_different_steps() -> None:
    node: Synchronizer[str] = Synchronizer(
        needed=lambda j, k: k - j, delay=0, agent=0, steps=300, inputs=[[1, 2]], peers=[1, 2], start=200
    )
    node.learn(0, 0, 0, 299)
    assert node.waiting_for() == "step 199 of agent 2, step 198 of agent 3"
    assert [node.offer(1, 199, "one"), node.offer(2, 198, "two")] == [None, None]
    assert node.inputs() == (0, ["one", "two"])


def test_what_it_refuses_of_a_peer_that_is_heard_late() -> None:
    node = lonely(200)
    assert node.offer(2, 200, "") == Refusal.NOT_A_PEER
    assert node.offer(1, 266, "") == Refusal.TOO_NEW
    assert node.offer(1, 100, "") is None  # the progress of a peer that is behind
    assert node.offer(1, 99, "") == Refusal.REPEATED


class Player:
    """Whoever gets the ball passes it on to the next one, until it has been passed often enough."""

    def __init__(self, game: "Game", number: int) -> None:
        self.game, self.number = game, number

    def advance(self) -> None:
        self.game.seen.append(self.number)
        if len(self.game.seen) < self.game.length:
            self.game.turns.ask(self.game.players[(self.number + 1) % len(self.game.players)])


class Game:
    def __init__(self, players: int, length: int, turn: float = TURN_SLICE) -> None:
        self.deferred: list[Callable[[], None]] = []
        self.turns = TurnQueue(players, self.deferred.append, self.end, turn)
        self.seen: list[int] = []
        self.ended: list[int] = []  # how many turns had been given when no more were
        self.length = length
        self.players = [Player(self, number) for number in range(players)]

    def end(self) -> None:
        self.ended.append(len(self.seen))


def test_nobody_before_all_have_joined() -> None:
    game = Game(3, 0)
    game.turns.join(game.players[2])
    game.turns.ask(game.players[2])
    game.turns.join(game.players[0])
    assert game.seen == []
    game.turns.join(game.players[1])
    assert game.seen == [2, 2, 0, 1]
    game.turns.ask(game.players[1])
    assert game.seen == [2, 2, 0, 1, 1]
    assert game.ended == [4, 5]
    assert game.deferred == []


def test_as_long_as_it_takes_without_nesting() -> None:
    """Many more turns than Python allows nested calls."""
    game = Game(3, 50_000, turn=1e9)
    for player in game.players:
        game.turns.join(player)
    assert len(game.seen) >= 50_000
    assert not game.deferred


def test_the_middleware_gets_its_turn() -> None:
    """A slice that is over at once: one turn, then everything else; whoever asks meanwhile waits for his."""
    game = Game(2, 6, turn=-1.0)
    for player in game.players:
        game.turns.join(player)
    assert game.seen == [0]
    for before in range(1, 5):
        game.turns.ask(game.players[0])
        assert len(game.seen) == before
        game.deferred.pop()()
        assert len(game.seen) == game.ended[-1] == before + 1
        assert len(game.deferred) == 1
    while game.deferred:
        game.deferred.pop()()
    assert len(game.seen) >= 6
    game.turns.ask(game.players[1])  # all done: at once again
    assert game.seen[-1] == 1
