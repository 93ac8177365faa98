"""What a player does that needs no ROS: time, topics, keys."""

import math

import pytest

from msg_agents.replay import BagClock, parse_remaps, select_topics
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.errors import InputError

TOPICS = ["/experiment", "/graph", "/agent_1/state", "/agent_2/state", "/lab/agent_1/state"]


class Wall:
    """A clock that goes when told to."""

    time = 100.0

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def wall() -> Wall:
    return Wall()


def test_time_runs_at_the_rate(wall: Wall) -> None:
    clock = BagClock(5 * SECOND, 2.0, wall=wall)
    assert clock.until(6 * SECOND) == 0.5
    wall.time += 0.25
    assert clock.now(10 * SECOND) == 5.5 * SECOND
    assert clock.until(6 * SECOND) == 0.25
    wall.time += 1.0
    assert clock.until(6 * SECOND) == -0.75


def test_time_never_passes_what_comes_next(wall: Wall) -> None:
    clock = BagClock(0, 1.0, wall=wall)
    wall.time += 9.0
    assert clock.now(3 * SECOND) == 3 * SECOND
    clock.pause(True, 3 * SECOND)
    assert clock.now(30 * SECOND) == 3 * SECOND


def test_paused_time_stands(wall: Wall) -> None:
    clock = BagClock(0, 1.0, paused=True, wall=wall)
    wall.time += 5.0
    assert (clock.now(SECOND), clock.until(SECOND)) == (0, math.inf)
    clock.jump(SECOND)
    assert clock.until(SECOND) == math.inf
    clock.pause(False, 9 * SECOND)
    assert clock.until(2 * SECOND) == 1.0
    wall.time += 0.5
    clock.pause(True, 9 * SECOND)
    wall.time += 7.0
    clock.pause(False, 9 * SECOND)
    assert clock.until(2 * SECOND) == 0.5


def test_a_reader_that_holds_back_costs_no_time_of_the_bag(wall: Wall) -> None:
    clock = BagClock(0, 4.0, wall=wall)
    wall.time += 2.0
    clock.hold(1.5)
    assert clock.now(9 * SECOND) == 2 * SECOND


def test_the_rate_changes_from_now_on(wall: Wall) -> None:
    clock = BagClock(0, 1.0, wall=wall)
    wall.time += 1.0
    clock.change_rate(2.0, 9 * SECOND)
    assert (clock.rate, clock.until(3 * SECOND)) == (2.0, 1.0)
    wall.time += 1.0
    assert clock.now(9 * SECOND) == 3 * SECOND


def test_as_fast_as_it_goes(wall: Wall) -> None:
    clock = BagClock(0, math.inf, wall=wall)
    assert (clock.until(10**15), clock.now(7)) == (0.0, 7)
    clock.change_rate(1.1, 7)
    assert clock.rate == math.inf
    clock.pause(True, 7)
    assert clock.until(8) == math.inf


@pytest.mark.parametrize(
    ("wanted", "excluded", "chosen"),
    [
        ([], [], TOPICS),
        (["/graph"], [], ["/graph"]),
        (["graph", "experiment"], [], ["/experiment", "/graph"]),
        (["/agent_*/state"], [], ["/agent_1/state", "/agent_2/state"]),
        (["/agent_[2]/*"], [], ["/agent_2/state"]),
        ([], ["*state"], ["/experiment", "/graph"]),
        (["/agent_*"], ["/agent_1/state"], ["/agent_2/state"]),
    ],
)
def test_topics_are_selected(wanted: list[str], excluded: list[str], chosen: list[str]) -> None:
    assert select_topics(TOPICS, wanted, excluded) == chosen


@pytest.mark.parametrize(
    ("wanted", "excluded", "said"),
    [
        (["/nobody"], [], r"--topics: /nobody: no such topic in the bag: expected one of /experiment, /graph"),
        ([], ["/agent_9/*"], r"--exclude: /agent_9/\*: no such topic"),
        (["/graph"], ["*"], r"--exclude: \*: leaves no topic to play"),
    ],
)
def test_mistakes_in_the_selection(wanted: list[str], excluded: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        select_topics(TOPICS, wanted, excluded)


def test_topics_are_renamed() -> None:
    names = parse_remaps(["graph:=lab/graph", "/experiment:=/e"], ["/graph", "/experiment", "/x"])
    assert names == {"/graph": "/lab/graph", "/experiment": "/e", "/x": "/x"}


@pytest.mark.parametrize("remap", ["", "a", "a:=", ":=b", "a=b", "/x:=/y"])
def test_mistakes_in_remaps(remap: str) -> None:
    with pytest.raises(InputError, match=f"^--remap: {remap}|no such topic is played: expected one of /graph"):
        parse_remaps([remap], ["/graph"])
