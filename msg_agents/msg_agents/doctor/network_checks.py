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

"""Sockets of this machine, and its ROS domains."""

from __future__ import annotations

import os
import socket

from msg_agents.discovery.loopback import loopback_has_multicast, require_loopback
from msg_agents.discovery.ros_domain import DOMAINS, domains_with_ports_in_use, free_domain, is_held
from msg_agents.doctor.check import Check, refusal, warn_if
from msg_agents.processes.environment import check_domain
from msg_analysis.errors import InputError

WANTED = 4 << 20  # bytes of a receive buffer, as in the profiles of Fast DDS
LEAST = 212_992  # bytes, what Linux allows by default
SHOWN = 5  # taken domains


def check_loopback() -> Check:
    """Whether processes of this machine can reach each other."""
    return refusal("loopback", require_loopback) or Check("loopback", "ok", "messages over UDP arrive")


def check_multicast() -> Check:
    """Whether ROS programs that find each other by multicast could do so here."""
    warning = None
    if not loopback_has_multicast():
        warning = (
            "not on the loopback interface: a run does not need it, but `ros2` tools and single nodes may not find "
            "each other: `ip link set lo multicast on`, or set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST for them"
        )
    return warn_if("multicast", warning, "works on the loopback interface")


def check_buffers() -> Check:
    """How much a socket keeps for a reader that is busy."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        sizes = {}
        for name, option in (("rmem_max", socket.SO_RCVBUF), ("wmem_max", socket.SO_SNDBUF)):
            probe.setsockopt(socket.SOL_SOCKET, option, WANTED)
            sizes[name] = probe.getsockopt(socket.SOL_SOCKET, option) // 2  # Linux doubles what is asked for
    return judge_buffers(**sizes)


def judge_buffers(rmem_max: int, wmem_max: int) -> Check:
    """Of the sizes [bytes] that sockets get, at most those that the profiles ask for."""
    small = [name for name, size in (("rmem_max", rmem_max), ("wmem_max", wmem_max)) if size < LEAST]
    warning = None
    if small:
        remedy = " ".join(f"net.core.{name}={WANTED}" for name in small)
        warning = (
            f"receive {rmem_max}, send {wmem_max} bytes: messages that a busy process has no room for are sent again, "
            f"which is slow: as root, `sysctl -w {remedy}`"
        )
    return warn_if("socket_buffers", warning, f"receive {rmem_max}, send {wmem_max} bytes", rmem_max)


def check_own_domain() -> Check:
    """The domain of this shell, which single nodes and `ros2` use."""
    name = "ros_domain_id"
    value = os.environ.get("ROS_DOMAIN_ID")
    try:
        check_domain()
    except InputError as error:
        return Check(name, "warning", f"{error}: only a run with a domain of its own works")
    if not value:
        return Check(name, "ok", "not set: single nodes use 0, a run takes a free one", 0)
    domain = int(value)
    taken = domain in DOMAINS and is_held(domain)
    warning = None
    if taken or domain in domains_with_ports_in_use():
        by = "another run holds this domain" if taken else "other programs are in this domain"
        warning = f"ROS_DOMAIN_ID: {domain}: {by}: a run takes a free one, but single nodes would meet: choose another"
    return warn_if(name, warning, f"{domain}: single nodes use it, a run takes a free one", domain)


def check_free_domains() -> Check:
    """How many further runs the domains and their UDP ports suffice for."""
    name = "free_domains"

    def take_one() -> None:
        with free_domain():
            pass

    if found := refusal(name, take_one):
        return found
    busy = domains_with_ports_in_use()
    taken = [domain for domain in DOMAINS if domain in busy or is_held(domain)]
    more = f", and {len(taken) - SHOWN} more" if len(taken) > SHOWN else ""
    which = f"; taken: {', '.join(map(str, taken[:SHOWN]))}{more}" if taken else ""
    free = len(DOMAINS) - len(taken)
    return Check(name, "ok", f"{free} of {len(DOMAINS)}, with their UDP ports{which}", free)
