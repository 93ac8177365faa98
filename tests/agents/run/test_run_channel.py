"""What is predicted and said of a run over a channel."""

from typing import Any

import numpy as np
import pytest
from networks import experiment

from msg_agents.channel.channel_file import Channel
from msg_agents.run.run_channel import channel_findings, predicted_errors
from msg_analysis.inference.timing import LostMessages

SLOW = {"generator": [[-0.5, 0.5], [0.5, -0.5]]}
REALTIME = {"replicas": 1, "pace": "realtime"}
TWO_HOSTS = {"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}}


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        ({}, 1.419874),
        ({"default": {"loss": 0.2}}, 1.416858),
        ({"default": {"loss": 0.5}, "recorder": "clean"}, 1.411983),
        ({"default": {"loss": 0.2}, "hosts": TWO_HOSTS}, 1.420236),
        ({"default": {"loss": 0.8}, "hosts": TWO_HOSTS}, 1.446306),
    ],
)
def test_the_last_value_heard(channel: dict[str, Any], expected: float) -> None:
    """The prototype has the agents step in the order of their numbers, which moves the third digit after the point."""
    what = experiment(switching=SLOW, run=REALTIME)
    predicted = predicted_errors(Channel.parse(channel, what), what)
    assert predicted["system_error"] == pytest.approx(expected, abs=1e-3)
    assert sum(predicted["node_errors"]) == pytest.approx(predicted["system_error"])


@pytest.mark.parametrize(
    ("channel", "run"),
    [
        ({"default": {"loss": 0.2}}, {"pace": "lockstep"}),
        ({"default": {"loss": 0.2}}, {"delivery": "reliable"}),
        ({"default": {"loss": 0.2, "burst": 4}}, {}),
        ({"default": {"loss": 0.2}, "graph": True}, {}),
    ],
)
def test_where_something_else_decides(channel: dict[str, Any], run: dict[str, Any]) -> None:
    what = experiment(switching=SLOW, run=REALTIME | run)
    assert predicted_errors(Channel.parse(channel, what), what) is None


def pair(sender: str, receiver: str, **changes: Any) -> dict[str, Any]:
    counts = {"sent": 10_000, "lost": 2_000, "queued": 0, "dropped": 0, "cut": 0, "loss": 0.2, "inflation": 1.0}
    return {"sender": sender, "receiver": receiver} | counts | changes


def channel(*pairs: dict[str, Any], overflowed: int = 0, late: float = 0.1) -> dict[str, Any]:
    hosts = {"base": {"agents": []}, "left": {"agents": [1, 2]}, "right": {"agents": [3]}}
    rows = pairs or (pair("left", "right"), pair("right", "left"))
    return {"hosts": hosts, "pairs": list(rows), "overflowed": overflowed, "late_ms": {"mean": late, "max": 9.0}}


def lost(between_hosts: int, on_one_host: int = 0, probability: float = 0.0) -> LostMessages:
    """10,000 messages on each of the links 1 to 2 and 1 to 3."""
    links = np.array([[1, 0], [2, 0]])
    lost = np.array([on_one_host, between_hosts])
    return LostMessages(links, np.array([10_000, 10_000]), lost, np.full(2, probability), 1.0)


def test_a_channel_that_does_what_its_file_says() -> None:
    assert channel_findings(channel()) == []
    assert channel_findings(channel(), lost(0), 10.0) == []
    assert channel_findings(channel(pair("left", "right", lost=2_190))) == []  # 4.75 standard errors
    assert channel_findings(channel(pair("left", "right", lost=0, loss=0.0))) == []


def test_other_losses_than_those_of_the_file() -> None:
    (words,) = channel_findings(channel(pair("left", "right", lost=2_210)))
    assert words == "22.1 % of the 10000 packets from left to right were lost at random, not 20 %."
    assert channel_findings(channel(pair("left", "right", lost=2_210, inflation=3.0))) == []
    (words,) = channel_findings(channel(pair("left", "right", lost=1, loss=0.0)))
    assert words.endswith("from left to right were lost at random, not 0 %.")


def test_full_queues_overflow_and_lateness() -> None:
    rows = [pair("left", f"host{number}", dropped=100 * number) for number in range(1, 6)]
    found = channel_findings(channel(*rows, overflowed=1, late=2.0), None, 10.0)
    assert found[0] == (
        "5 % of the packets from left to host5 were dropped by the full queue: more traffic than its rate_mbit carries."
    )
    assert found[3] == "The same is true of 2 more of these pairs."
    assert found[4] == "1 packet came faster than the channel could take them: it lost more than its file says."
    assert found[5].startswith(
        "Packets were passed on 2.0 ms later than the file says, on average, with a period of 10"
    )
    assert len(found) == 6
    assert channel_findings(channel(late=0.9), None, 10.0) == []
    assert channel_findings(channel() | {"late_ms": None}, None, 10.0) == []


def test_whose_lost_messages_are() -> None:
    """Half of the messages go from host to host; neither of the two may have lost them, or they came again."""
    (words,) = channel_findings(channel(), lost(2_000), 10.0)
    assert words == (
        "Of the messages between agents, 10 % (9.59 to 10.4 %) were not received in time: the experiment loses 0 %, "
        "the channel 10 % more."
    )
    (words,) = channel_findings(channel(), lost(3_600, 2_000, 0.2), 10.0)
    assert words.endswith("the experiment loses 20 %, the channel 8 % more.")
    (words,) = channel_findings(channel(), lost(4_000), 10.0)
    assert words.endswith("the channel 10 % more; the others were late or dropped.")
    (words,) = channel_findings(channel(), lost(1_000), 10.0)
    assert words.endswith("the channel 10 % more; lost messages were sent again in time.")
