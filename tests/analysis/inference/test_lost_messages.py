"""Messages that were not heard in time, against the twin's draws and a count message by message."""

import late_timers
import numpy as np
import pytest
from late_timers import busy

from experiments import claimed, directed, observed, predict, simulate
from msg_analysis.inference.timing import lost_messages, measure_timing
from msg_analysis.model.reception import Losses


def real_time(duration=400, **noise):
    run = {"duration": duration, "pace": "realtime", "replicas": 1}
    return directed(noise={"process": 1.0} | noise, run=run)


def by_hand(trajectory, receiver, sender):
    """(messages, lost) of one link, message by message."""
    step = predict(trajectory.record.experiment).step
    prefix, modes = trajectory.prefix, trajectory.agent_modes[:, receiver].tolist()
    read, sent = trajectory.made[:, receiver].tolist(), trajectory.made[:, sender].tolist()
    rows = trajectory.used[:, receiver].tolist()
    lists = [step.neighbours(graph, receiver).tolist() for graph in range(step.modes)]

    def used(k):
        neighbours = lists[modes[k + 1]]
        return rows[k][neighbours.index(sender)] if sender in neighbours else None

    def there(n, k):
        """Whether message n was there at step k; of equal times, only if it or a newer one was used."""
        if n > prefix:
            return False
        time, published = read[k + 1], sent[n]
        return published < time or (published == time and (used(k + step.delay) or -1) >= n)

    messages = lost = k = 0
    last = prefix - step.delay - 1
    for n in range(1, prefix + 1):
        k = next((at for at in range(k, last) if there(n, at)), last)
        if k == last or k < max(step.delay + step.holds, 1) or there(n + 1, k):
            continue
        uses = used(k + step.delay), used(k + step.delay + 1)
        if None not in uses:
            messages, lost = messages + 1, lost + (n not in uses)
    return messages, lost


@pytest.mark.parametrize("on_loss", ["hold", "own"])
def test_lost_messages_are_those_that_were_drawn(on_loss):
    """|z| < 4: false-alarm rate 6e-5 for each of the two."""
    trajectory = simulate(real_time(100, loss=0.2, on_loss=on_loss))
    found = measure_timing(observed(trajectory)).lost_messages
    share, (low, high), expected = found.share()
    assert expected == pytest.approx(0.2)
    assert abs(share - 0.2) < 4 * np.sqrt(0.2 * 0.8 / found.messages.sum())
    assert low < share < high
    assert found.words() is None
    by_link = list(zip(found.messages, found.lost, strict=True))
    assert by_link == [by_hand(trajectory, *link) for link in found.links.tolist()]
    document = found.to_json()
    assert (document["lost"], document["words"]) == (sum(link["lost"] for link in document["links"]), None)
    assert [document["expected"], *(link["expected"] for link in document["links"])] == pytest.approx([0.2] * 7)


def test_of_a_link_that_is_always_there_the_lost_ones_are_found():
    """Message by message, in the order of the twin's draws."""
    what = real_time(100, loss={"arcs": [[2, 3, 0.3]]}, on_loss="hold")
    found = lost_messages(observed(simulate(what)))
    place = found.links.tolist().index([2, 1])
    lost = np.concatenate([Losses(what).block(2, 1, number) for number in range(4)])[:1000]
    # The first two and the last two may not be judged.
    assert found.messages[place] >= 996
    assert abs(found.lost[place] - lost.sum()) <= 4
    assert found.lost.sum() == found.lost[place]


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_with_ideal_timers_every_message_is_heard(delay):
    """What the experiment delays is not late."""
    found = lost_messages(observed(simulate(real_time(delay=delay))))
    assert found.messages.min() > 500
    assert (found.lost.sum(), found.words()) == (0, None)


def test_other_losses_are_put_into_words():
    """That the experiment does not have, and that were not made."""
    trajectory = claimed(simulate(real_time(loss={"arcs": [[2, 3, 0.3]]}, on_loss="hold")), real_time())
    words = lost_messages(observed(trajectory)).words()
    assert "while the experiment loses 0 %: the network lost them or was late" in words
    assert words.endswith("% of those from agent 2 to agent 3")
    trajectory = claimed(simulate(real_time()), real_time(loss=0.2, on_loss="hold"))
    words = lost_messages(observed(trajectory)).words()
    assert words.startswith("0 % (0 to ")
    assert "while the experiment loses 20 %: the experiment's losses were not made" in words


def test_late_agents_and_messages():
    """Receivers that are late have not missed what came twice in their period; slow messages are overtaken."""
    slow = late_timers.run(real_time(40), slow=busy(0.5, 2.5), late=busy(0.3, 1.5))
    found = lost_messages(observed(slow))
    assert found.lost.sum() > 0
    by_link = list(zip(found.messages, found.lost, strict=True))
    assert by_link == [by_hand(slow, *link) for link in found.links.tolist()]
