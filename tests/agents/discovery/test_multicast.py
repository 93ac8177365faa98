"""Messages by multicast: heard at every interface of the network, and on this machine only."""

from __future__ import annotations

import socket
import struct
from pathlib import Path

import pytest

from msg_agents.discovery.rtps import GROUP, LOOPBACK_INTERFACES, announce_here, free_domain, multicast_port

IP_RECVTTL = 12  # Linux


def interfaces() -> list[tuple[int, str]]:
    """Those that can have multicast and an address: the kernel lists the groups of each."""
    members = Path("/proc/net/igmp").read_text()
    flags = {n: int(Path(f"/sys/class/net/{n}/flags").read_text(), 16) for _, n in socket.if_nameindex()}
    return [(i, n) for i, n in socket.if_nameindex() if flags[n] & 0x1001 == 0x1001 and f"{n}" in members]


def test_it_is_heard_at_the_interface_and_leaves_no_machine() -> None:
    found = [(i, n) for i, n in interfaces() if n not in LOOPBACK_INTERFACES]
    if not found:
        pytest.skip("no interface of a network")
    with free_domain() as domain, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.IPPROTO_IP, IP_RECVTTL, 1)
        receiver.bind(("", multicast_port(domain)))
        index, _ = found[0]
        membership = struct.pack("4s4si", socket.inet_aton(GROUP), b"", index)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiver.settimeout(5)
        announce_here(b"here", domain)
        data, (control, *_), *_ = receiver.recvmsg(100, 100)
    assert data == b"here"
    assert struct.unpack("i", control[2]) == (0,)  # a router, and the interface itself, drop it
