"""Real hosts: namespaces with TUN devices, and datagrams that the channel carries between them."""

import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_agents.channel.channel_file import Channel
from msg_agents.channel.links import LinkSettings, LossModel, destinations
from msg_agents.channel.process import ActiveGraphFile, Host, enter, hand_over, host_address, open_hosts, serve
from msg_analysis.errors import NotAvailableError

NAMES = ["base", "left", "right"]
PORT, GROUP = 7411, "239.255.0.1"
EVERYTHING = LossModel(1.0, 1.0, 0.0, 1.0)


@pytest.fixture
def hosts() -> Iterator[dict[str, Host]]:
    try:
        with open_hosts(NAMES, 9000) as opened:
            yield opened
    except NotAvailableError as error:
        pytest.skip(f"no rights: {error}")


def on_host(host: Host, do: Callable[[], Any]) -> Any:
    """Do something in a thread that is on a host."""
    done: list[Any] = []

    def work() -> None:
        enter(os.dup(host.namespace))
        done.append(do())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return done[0]


def bound() -> socket.socket:
    """A socket that hears datagrams, and those of a multicast group, as the middleware makes it."""
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found.bind(("", PORT))
    place = next(a for a in map(host_address, range(3)) if _is_own(a))
    found.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + socket.inet_aton(place))
    found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(place))
    found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
    found.settimeout(10)
    return found


def _is_own(address: str) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((address, 0))
        except OSError:
            return False
    return True


class Running:
    """A channel in a thread of this process."""

    def __init__(
        self,
        hosts: dict[str, Host],
        folder: Path,
        links: dict[tuple[str, str], LinkSettings] | None = None,
        joined: Any = None,
        graph: Path | None = None,
    ) -> None:
        self.sockets = {name: on_host(host, bound) for name, host in hosts.items()}
        self.addresses = {name: host.address for name, host in hosts.items()}
        every = {(a, b): (links or {}).get((a, b), LinkSettings()) for a in NAMES for b in NAMES if a != b}
        self.counts_file = folder / "counts.json"
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel = Channel(5, dict.fromkeys(NAMES, ()), every, graph is not None, 9000)
        hand_over(self._control, channel, hosts, self.counts_file, graph, joined)
        self._thread = threading.Thread(target=serve, args=(theirs.detach(),))
        self._thread.start()

    def send(self, sender: str, receiver: str, data: bytes) -> None:
        self.sockets[sender].sendto(data, (self.addresses.get(receiver, receiver), PORT))

    def end(self) -> dict[tuple[str, str], dict[str, int]]:
        """End it as a run does; what was counted."""
        for found in self.sockets.values():
            found.close()
        self._control.close()
        self._thread.join(10)
        assert not self._thread.is_alive()
        counts = json.loads(self.counts_file.read_bytes())
        return {(pair["sender"], pair["receiver"]): pair for pair in counts["pairs"]}


@pytest.fixture
def start(hosts: dict[str, Host], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Running]:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the channel is in a thread here
    monkeypatch.setattr(os, "setpriority", lambda *_: None)
    return partial(Running, hosts, tmp_path)


def test_datagrams_reach_their_host_with_their_bytes(start: Callable[..., Running]) -> None:
    channel = start()
    data = os.urandom(8000)
    channel.send("left", "right", data)
    assert channel.sockets["right"].recvfrom(1 << 16) == (data, (channel.addresses["left"], PORT))
    counts = channel.end()
    pair = counts["left", "right"]
    assert (pair["sent"], pair["bytes"], pair["lost"]) == (1, 8000 + 20 + 8, 0)  # with the headers of IP and UDP
    assert counts["right", "left"]["sent"] == 0


def test_multicast_reaches_all_others(start: Callable[..., Running]) -> None:
    channel = start()
    channel.send("left", GROUP, b"to all")
    assert [channel.sockets[name].recv(100) for name in ("base", "right")] == [b"to all"] * 2
    assert {pair for pair, found in channel.end().items() if found["sent"]} == {("left", "base"), ("left", "right")}


def test_what_is_lost_does_not_arrive(start: Callable[..., Running]) -> None:
    channel = start({("left", "right"): LinkSettings(EVERYTHING)})
    for number in range(20):
        channel.send("left", "right", bytes([number]))
    channel.send("base", "right", b"last")
    assert channel.sockets["right"].recv(100) == b"last"
    counts = channel.end()
    assert (counts["left", "right"]["sent"], counts["left", "right"]["lost"]) == (20, 20)


def test_delayed_datagrams_come_in_order_and_not_before_their_time(start: Callable[..., Running]) -> None:
    channel = start({("left", "right"): LinkSettings(delay=0.05, jitter=0.05)})
    sent = []
    for number in range(50):
        sent.append(time.monotonic())
        channel.send("left", "right", bytes([number]))
    heard = [(channel.sockets["right"].recv(100), time.monotonic()) for _ in range(50)]
    channel.end()
    assert [data for data, _ in heard] == [bytes([number]) for number in range(50)]
    assert max(arrival - departure for (_, arrival), departure in zip(heard, sent, strict=True)) > 0.05


def test_a_full_queue_drops(start: Callable[..., Running]) -> None:
    channel = start({("left", "right"): LinkSettings(rate=0.008, queue=1)})  # 1000 bytes a second
    for number in range(10):
        channel.send("left", "right", bytes([number]) * 100)
    channel.send("left", "base", b"taken")  # after the others
    assert channel.sockets["base"].recv(100) == b"taken"
    counts = channel.end()["left", "right"]
    assert (counts["sent"], counts["queued"], counts["dropped"]) == (10, 1, 8)


def test_the_active_graph_cuts(start: Callable[..., Running], tmp_path: Path) -> None:
    """In graph 1 all are joined, in graph 2 left and right are not, unless one of them is let through."""
    graph = ActiveGraphFile.create(tmp_path / "graph", 3)
    joined = np.ones((2, 3, 3), dtype=bool)
    joined[1, 1, 2] = joined[1, 2, 1] = False
    channel = start(joined=joined, graph=tmp_path / "graph")
    for number, (mode, host) in enumerate([(-1, 0), (1, 0), (0, 0), (1, 0), (1, 1), (1, 2), (1, 0)]):
        graph.set_mode(mode)
        for place in range(3):
            graph.let_through(place, all_packets=place == host)
        channel.send("left", "right", bytes([number]))
        channel.send("left", "base", b"next")
        assert channel.sockets["base"].recv(100) == b"next"  # what came before it has been decided
    assert [channel.sockets["right"].recv(100) for _ in range(4)] == [b"\0", b"\2", b"\4", b"\5"]
    assert channel.end()["left", "right"]["cut"] == 3


def test_hosts_are_gone_with_their_descriptors(hosts: dict[str, Host]) -> None:
    """Nothing of them is in the namespace of this process, and nothing has a name."""
    inodes = {os.fstat(host.namespace).st_ino for host in hosts.values()}
    assert len(inodes) == 3
    assert Path("/proc/self/ns/net").stat().st_ino not in inodes
    assert "channel" not in Path("/proc/self/net/dev").read_text()
    for host in hosts.values():
        host.close_device()
        devices = on_host(host, lambda: Path("/proc/thread-self/net/dev").read_text())
        assert "channel:" not in devices, "a device outlived the channel"


def packet(target: str, protocol: int = 17) -> bytes:
    """The head of an IPv4 packet (RFC 791): version and length, ..., protocol at byte 9, target at byte 16."""
    return bytes([0x45, 0, 0, 28, 0, 0, 0, 0, 64, protocol, 0, 0]) + bytes(4) + socket.inet_aton(target) + bytes(8)


def test_destinations() -> None:
    places = {socket.inet_aton(host_address(i)): i for i in range(3)}
    assert list(destinations(packet("10.77.0.3"), 0, places)) == [2]
    assert list(destinations(packet("10.77.0.1"), 0, places)) == []
    assert list(destinations(packet("10.77.0.9"), 0, places)) == []
    assert list(destinations(packet("239.255.0.1"), 1, places)) == [0, 2]
    assert list(destinations(packet("224.0.0.22", protocol=2), 1, places)) == []  # IGMP
    assert list(destinations(b"\x60" + bytes(40), 1, places)) == []  # IPv6
    assert list(destinations(b"\x45", 1, places)) == []
