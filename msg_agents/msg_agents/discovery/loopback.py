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

"""Whether this machine can send messages to itself."""

from __future__ import annotations

import socket

from msg_agents.discovery.rtps import GROUP, LOOPBACK
from msg_analysis.errors import InputError

PATIENCE = 1.0  # s; in the kernel, a message is there at once
WORD = b"msg_agents"


def require_loopback() -> None:
    """InputError unless messages over UDP arrive: the processes of a run exchange all theirs so."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind((LOOPBACK, 0))
            _exchange(receiver, LOOPBACK)
        except OSError as error:
            raise InputError(
                f"{LOOPBACK}: no message arrives ({error.strerror or error}): processes cannot find each other: set "
                "the interface up (`ip link set lo up`), or let UDP pass the firewall"
            ) from error


def loopback_has_multicast() -> bool:
    """Whether multicast messages arrive at processes of this machine over its loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind(("", 0))
            membership = socket.inet_aton(GROUP) + socket.inet_aton(LOOPBACK)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            _exchange(receiver, GROUP)
        except OSError:
            return False
    return True


def _exchange(receiver: socket.socket, address: str) -> None:
    """Send a message over loopback, and receive it; OSError: that was not possible."""
    receiver.settimeout(PATIENCE)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
        sender.sendto(WORD, (address, receiver.getsockname()[1]))
        while receiver.recv(len(WORD) + 1) != WORD:  # of somebody else
            pass
