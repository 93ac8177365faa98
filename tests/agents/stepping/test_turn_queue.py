"""TurnQueue of the agents of one process."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from msg_agents.stepping import synchronizer
from msg_agents.stepping.synchronizer import TurnQueue


class Player:
    """Whoever gets the ball passes it on to the next one, until it has been passed often enough."""

    def __init__(self, game: Game, number: int) -> None:
        self.game, self.number = game, number

    def advance(self) -> None:
        self.game.seen.append(self.number)
        if len(self.game.seen) < self.game.length:
            self.game.turns.ask(self.game.players[(self.number + 1) % len(self.game.players)])


class Game:
    def __init__(self, players: int, length: int) -> None:
        self.deferred: list[Callable[[], None]] = []
        self.turns = TurnQueue(players, self.deferred.append, self.end)
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


def test_as_long_as_it_takes_without_nesting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many more turns than Python allows nested calls."""
    monkeypatch.setattr(synchronizer, "TURN_SLICE", 1e9)
    game = Game(3, 50_000)
    for player in game.players:
        game.turns.join(player)
    assert len(game.seen) >= 50_000
    assert not game.deferred


def test_the_middleware_gets_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slice that is over at once: one turn, then everything else; whoever asks meanwhile waits for his."""
    monkeypatch.setattr(synchronizer, "TURN_SLICE", -1.0)
    game = Game(2, 6)
    for player in game.players:
        game.turns.join(player)
    assert game.seen == [0]
    slices = 0
    while game.deferred:
        before = len(game.seen)
        game.turns.ask(game.players[0])
        assert len(game.seen) == before
        game.deferred.pop()()
        assert len(game.seen) == before + 1
        assert game.ended[-1] == before + 1
        assert len(game.deferred) <= 1
        slices += 1
        if slices == 4:
            break
    while game.deferred:
        game.deferred.pop()()
    assert len(game.seen) >= 6
    game.turns.ask(game.players[1])  # all done: at once again
    assert game.seen[-1] == 1
