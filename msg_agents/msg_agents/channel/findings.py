# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a channel did to a run beyond its file and the experiment, in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from msg_analysis.common.text.number_words import counted, percent

if TYPE_CHECKING:
    from msg_analysis.inference.realtime.unheard import UnheardMessages

MOST_Z = 5.0  # of the packets that a pair lost; by chance, any of 1000 pairs is beyond it in 0.06 % of all runs
SHOWN_PAIRS = 3


def channel_findings(
    channel: Mapping[str, Any], unheard: UnheardMessages | None = None, period_ms: float | None = None
) -> list[str]:
    """Sentences about ``channel``, as in the result of a run, and about the messages of its log in real time."""
    pairs = channel["pairs"]
    found = [words for pair in pairs if (words := _unlike_the_file(pair))]
    full = sorted((pair for pair in pairs if pair["dropped"]), key=lambda pair: -pair["dropped"] / pair["sent"])
    found += [
        f"{percent(pair['dropped'] / pair['sent'])} of the packets from {pair['sender']} to {pair['receiver']} were "
        "dropped by the full queue: more traffic than its rate_mbit carries"
        for pair in full
    ]
    left_out = len(found) - SHOWN_PAIRS
    if left_out > 0:
        found = [*found[:SHOWN_PAIRS], f"the same is true of {left_out} more of these pairs"]
    if channel["overflowed"]:
        found.append(
            f"{counted(channel['overflowed'], 'packet')} came faster than the channel could take them: it lost more "
            "than its file says"
        )
    late = channel["late_ms"]
    if late and period_ms and late["mean"] > period_ms / 10:
        found.append(
            f"packets were passed on {late['mean']:.1f} ms later than the file says, on average, with a period of "
            f"{period_ms:.3g} ms: the machine is too busy for this channel"
        )
    if unheard is not None and unheard.words():
        found.append(_messages(channel, unheard))
    return [f"{words[:1].upper()}{words[1:]}." for words in found]


def _unlike_the_file(pair: Mapping[str, Any]) -> str | None:
    """That a pair lost another share at random than the file says; that is rare where it does what it should."""
    sent, loss = pair["sent"], pair["loss"]
    spread = math.sqrt(sent * loss * (1.0 - loss) * pair["inflation"])
    if abs(pair["lost"] - sent * loss) <= max(MOST_Z * spread, 0.5):
        return None
    return (
        f"{percent(pair['lost'] / sent)} of the {sent} packets from {pair['sender']} to {pair['receiver']} were lost "
        f"at random, not {percent(loss)}"
    )


def _messages(channel: Mapping[str, Any], unheard: UnheardMessages) -> str:
    """Why messages were not heard in time: the losses of the experiment, those of the channel, and the rest."""
    host = {agent - 1: name for name, host in channel["hosts"].items() for agent in host["agents"]}
    losses = {(pair["sender"], pair["receiver"]): pair["loss"] for pair in channel["pairs"]}
    by_channel = by_both = 0.0
    rows = zip(unheard.links.tolist(), unheard.messages.tolist(), unheard.probability.tolist(), strict=True)
    for (receiver, sender), messages, probability in rows:
        loss = losses.get((host[sender], host[receiver]), 0.0)
        by_channel += messages * (1.0 - probability) * loss
        by_both += messages * (probability + (1.0 - probability) * loss)
    share, interval, expected = unheard.share()
    total = int(unheard.messages.sum())
    words = (
        f"of the messages between agents, {percent(share)} ({100 * interval[0]:.3g} to {100 * interval[1]:.3g} %) were "
        f"not heard in time: the experiment loses {percent(expected)}, the channel {percent(by_channel / total)} more"
    )
    if interval[0] > by_both / total:
        return f"{words}; the others were late or dropped"
    if interval[1] < by_both / total:
        return f"{words}; lost messages were sent again in time"
    return words
