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
"""The process of the channel: what the run tells it, and its work until the run closes their socket.

The socket is also its lifeline: it ends with the process that holds the other end, for whatever reason.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from msg_agents.channel.active_graph import ActiveGraphFile
from msg_agents.channel.channel_file import Channel
from msg_agents.channel.counts import ChannelCounts
from msg_agents.channel.forwarding import Forwarder, Port
from msg_agents.channel.link import Link, LinkSettings, LossModel
from msg_agents.channel.namespaces import Host
from msg_analysis.types import BoolArray

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
