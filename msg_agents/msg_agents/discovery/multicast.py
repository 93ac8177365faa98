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

"""Multicast from every interface of the network that does not leave this machine."""

from __future__ import annotations

import contextlib
import socket
import struct

from msg_agents.discovery.rtps import GROUP, multicast_port

LOOPBACK_INTERFACES = ("lo", "lo0")  # on Linux, elsewhere


def announce_here(datagram: bytes, domain: int) -> None:
    """Send an announcement to the participants on this machine that hear a domain's group at an interface.

    One of Cyclone DDS has no number by default, and hears of others only there.
    """
    for index, name in socket.if_nameindex():
        if name in LOOPBACK_INTERFACES:  # the processes of the run hear the group there, and would all answer
            continue
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("4s4si", b"", b"", index))
            sender.sendto(datagram, (GROUP, multicast_port(domain)))  # an interface without address has no route
