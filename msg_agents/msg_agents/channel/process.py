# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The process of the channel: what the run tells it, and its work until the run closes their socket.

The socket is also its lifeline: it ends with the process that holds the other end, for whatever reason.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msg_agents.channel.channel_file import Channel
from msg_agents.channel.links import ActiveGraphFile, ChannelCounts, Forwarder, Link, LinkSettings, LossModel, Port
from msg_agents.channel.namespaces import Host
from msg_analysis.common.arrays import BoolArray
from msg_analysis.common.text import counted, percent

if TYPE_CHECKING:
    from msg_analysis.inference.timing import LostMessages


MOST_Z = 5.0  # of the packets that a pair lost; by chance, any of 1000 pairs is beyond it in 0.06 % of all runs
SHOWN_PAIRS = 3


def channel_findings(
    channel: Mapping[str, Any], unheard: LostMessages | None = None, period_ms: float | None = None
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


def _messages(channel: Mapping[str, Any], unheard: LostMessages) -> str:
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


LONGEST = 1 << 16  # bytes of a message that describes a host
PRIORITY = -10  # a delay is that of the link, not that of the scheduler


def hand_over(
    control: socket.socket,
    channel: Channel,
    hosts: Mapping[str, Host],
    counts: Path,  # file to write
    active_graph: Path | None,  # file to read, with ``joined``
    joined: BoolArray | None,
) -> None:
    """Tell a new process of the channel what to do; afterwards the devices are its own."""
    orders = {
        "seed": channel.seed,
        "counts": str(counts),
        "active_graph": active_graph and str(active_graph),
        "joined": None if joined is None else joined.tolist(),
        "links": [
            [sender, receiver, _settings_to_json(settings)] for (sender, receiver), settings in channel.links.items()
        ],
    }
    for name, host in hosts.items():
        message = json.dumps({"name": name, "address": host.address}).encode()
        socket.send_fds(control, [message], [host.device, host.statistics])
        host.close_device()
    file = counts.with_name("channel.json")
    file.write_text(json.dumps(orders), encoding="utf-8")
    control.send(json.dumps({"orders": str(file)}).encode())


def _settings_to_json(settings: LinkSettings) -> dict[str, Any]:
    loss = settings.loss
    rate = None if settings.rate == float("inf") else settings.rate
    return {
        "loss": [loss.good, loss.bad, loss.to_bad, loss.to_good],
        "delay": settings.delay,
        "jitter": settings.jitter,
        "rate": rate,
        "queue": settings.queue,
    }


def _settings_from_json(document: dict[str, Any]) -> LinkSettings:
    rate = float("inf") if document["rate"] is None else document["rate"]
    return LinkSettings(**document | {"loss": LossModel(*document["loss"]), "rate": rate})


def serve(descriptor: int) -> None:
    """Be the channel: ``descriptor`` is its end of the socket. Returns when the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run ends it, after all others
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with socket.socket(fileno=descriptor) as control:
        received = _receive(control)
        if received is None:
            return
        ports, orders = received
        places = {port.name: place for place, port in enumerate(ports)}
        links = {
            (places[sender], places[receiver]): Link(
                _settings_from_json(settings), orders["seed"], places[sender], places[receiver]
            )
            for sender, receiver, settings in orders["links"]
        }
        counts = Path(orders["counts"])

        def report(found: ChannelCounts) -> None:
            with contextlib.suppress(OSError):  # a full disk, or the run was killed and its folder is gone
                found.write(counts)

        Forwarder(ports, links, _gate(orders)).run(descriptor, report)


def _receive(control: socket.socket) -> tuple[list[Port], dict[str, Any]] | None:
    """The hosts, in order, and what to do; None if the run has ended meanwhile."""
    ports: list[Port] = []
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, LONGEST, 2)
        if not message:
            return None
        document = json.loads(message)
        if "orders" in document:
            return ports, json.loads(Path(document["orders"]).read_text(encoding="utf-8"))
        ports.append(Port(document["name"], socket.inet_aton(document["address"]), *descriptors))


def _gate(orders: dict[str, Any]) -> Callable[[int, int], bool]:
    """Whether packets from one host to another pass under the active graph."""
    if orders["joined"] is None:
        return lambda _sender, _receiver: True
    joined, active = orders["joined"], ActiveGraphFile(Path(orders["active_graph"]))

    def is_open(sender: int, receiver: int) -> bool:
        mode = active.mode
        return (
            mode < 0 or joined[mode][sender][receiver] or active.lets_through(sender) or active.lets_through(receiver)
        )

    return is_open
