# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Checks that start processes: discovery, a round trip, a small network."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from msg_agents.discovery.rtps import (
    DOMAINS,
    PROFILE_VARIABLES,
    domains_with_ports_in_use,
    free_domain,
    is_held,
    loopback_has_multicast,
    require_loopback,
)
from msg_agents.doctor import checks
from msg_agents.doctor.checks import CheckResult, refusal, warn_if
from msg_agents.environment import (
    LOCALHOST_VARIABLE,
    RANGE_VARIABLE,
    SERVER_VARIABLE,
    TRANSPORTS_VARIABLE,
    check_domain,
    node_environment,
    require_discovery,
)
from msg_agents.process_layout import MOST_UNAIDED
from msg_agents.run.runner import run_network
from msg_agents.terminal import raise_for
from msg_agents.watch.panel import View
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment

LIMIT = 12.0  # s for both agents to make steps: long enough for a machine that is busy
MEASURED = 0.5  # s of steps: some thousand
PAIR = {
    "name": "doctor",
    "graphs": {"pair": {"path": [1, 2]}},
    "run": {"dt": 0.01, "duration": 1000, "start": "zero", "processes": 2},
}
PER_ROUND_TRIP = 2  # steps: an agent waits in each for a message that the other one sent in the step before
VARIABLES_FILE = "FASTDDS_ENVIRONMENT_FILE"
NOT_USED = (TRANSPORTS_VARIABLE, "CYCLONEDDS_URI")  # with the run's own profile of Fast DDS
PEERS_VARIABLE = "ROS_STATIC_PEERS"
RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
UNAIDED = f"its processes look for each other, at most {MOST_UNAIDED} with agents"
WANTED = 4 << 20  # bytes of a receive buffer, as in the profiles of Fast DDS
LEAST = 212_992  # bytes, what Linux allows by default
SHOWN = 5  # taken domains


class _EnoughError(Exception):
    """The run is to end now."""


class _Stopwatch(View):
    """Measures the steps of a run, and ends it."""

    def __init__(self) -> None:
        super().__init__(lambda _: None, lambda _: None)
        self._start = time.monotonic()
        self._reports: list[tuple[float, int]] = []  # times at which the newest step was another one, and which
        self.rate = 0.0  # steps/s

    def look(self, steps: Sequence[int]) -> None:
        """The newest step of every agent; _EnoughError when they have been measured, or will not come any more."""
        now, reached = time.monotonic(), min(steps, default=-1)
        if reached >= 0 and (not self._reports or reached > self._reports[-1][1]):
            self._reports.append((now, reached))
            (began, first), (then, last) = self._reports[0], self._reports[-1]
            self.rate = (last - first) / (then - began) if then > began else 0.0
            if then - began >= MEASURED:
                raise _EnoughError
        if now - self._start > LIMIT:
            raise _EnoughError


def check_round_trip() -> CheckResult:
    """Whether two processes of a run hear each other, and how long a message takes there and back."""
    name, watch, what = "round_trip", _Stopwatch(), ""
    try:
        result = run_network(Experiment.parse(PAIR), None, restarts=0, view=watch)
        raise_for(result.interrupted_by)
        what = next(iter(result.failures), "")
    except InputError as error:
        return CheckResult(name, "error", str(error))
    except OSError as error:  # too few files or processes, a full disk
        return CheckResult(name, "error", f"two processes could not be started: {error}: raise that limit")
    except _EnoughError:
        pass
    if what or not watch.rate:
        remedy = "do what the warnings above say, and see docs/troubleshooting.md"
        return CheckResult(
            name, "error", f"two processes exchange messages: {what or f'not within {LIMIT:g} s'}: {remedy}"
        )
    duration = PER_ROUND_TRIP / watch.rate
    return CheckResult(name, "ok", f"{duration * 1e3:.2g} ms between two processes, computing included", duration)


def check_profiles() -> CheckResult:
    """Whether the run uses its own profile of Fast DDS."""
    warning = None
    if file := os.environ.get(VARIABLES_FILE):
        warning = f"{VARIABLES_FILE}: {file}: Fast DDS takes variables from it that may keep nodes apart: unset it"
    for name in PROFILE_VARIABLES:
        if value := os.environ.get(name):
            there = "instead of its own" if Path(value).is_file() else "instead of its own, and it is not there"
            warning = f"{name}: {value}: a run uses this file {there}: {UNAIDED}: unset it"
    others = ", ".join(f"{name}={value}" for name in NOT_USED if (value := os.environ.get(name)))
    return warn_if("profiles", warning, "the run's own" + (f" (without effect on it: {others})" if others else ""))


def check_range() -> CheckResult:
    """Where nodes look for others."""
    name = "discovery_range"
    if found := refusal(name, lambda: require_discovery(os.environ)):
        return found
    value, localhost = os.environ.get(RANGE_VARIABLE), os.environ.get(LOCALHOST_VARIABLE)
    warning = None
    if localhost == "1" and LOCALHOST_VARIABLE in node_environment(0):  # as with a profile or range of the user's
        warning = (
            f"{LOCALHOST_VARIABLE}: 1: replaced by {RANGE_VARIABLE} in ROS 2, but still stronger: nodes use "
            "shared memory, of which a killed process leaves its part behind: unset it"
        )
    elif value and value not in RANGES:
        warning = f"{RANGE_VARIABLE}: {value}: expected {', '.join(RANGES)}: unset it"
    elif value and value != "LOCALHOST":
        warning = f"{RANGE_VARIABLE}: {value}: a run keeps to it, perhaps beyond this machine: {UNAIDED}: unset it"
    return warn_if(name, warning, "this machine" + (f" ({LOCALHOST_VARIABLE}={localhost})" if localhost else ""))


def check_server() -> CheckResult:
    """Whether the user's other programs would see the run."""
    server = os.environ.get(SERVER_VARIABLE)
    warning = None
    if SERVER_VARIABLE in node_environment(0):  # as with a profile or range of the user's
        warning = f"{SERVER_VARIABLE}: {server}: the nodes of a run find each other only while it is there: unset it"
    elif server:
        warning = (
            f"{SERVER_VARIABLE}: {server}: a run does not use it, and other programs in this shell, such as "
            "`ros2 topic`, will not see the run: unset it"
        )
    return warn_if("discovery_server", warning, "none")


def check_peers() -> CheckResult:
    """Other machines that are named."""
    peers = os.environ.get(PEERS_VARIABLE)
    alone = (os.environ.get(RANGE_VARIABLE) or "LOCALHOST") == "LOCALHOST"
    warning = f"{PEERS_VARIABLE}: {peers}: nodes of a run contact these machines: unset it, or {RANGE_VARIABLE}"
    text = f"{peers} (not used by a run on this machine)" if peers else "none"
    return warn_if("static_peers", warning if peers and not alone else None, text)


def check_loopback() -> CheckResult:
    """Whether processes of this machine can reach each other."""
    return refusal("loopback", require_loopback) or CheckResult("loopback", "ok", "messages over UDP arrive")


def check_multicast() -> CheckResult:
    """Whether ROS programs that find each other by multicast could do so here."""
    warning = (
        "not on the loopback interface: a run does not need it, but `ros2` tools and single nodes may not find each "
        "other: `ip link set lo multicast on`, or set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST for them"
    )
    return warn_if("multicast", None if loopback_has_multicast() else warning, "works on the loopback interface")


def check_buffers() -> CheckResult:
    """How much a socket keeps for a reader that is busy."""
    sizes = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            probe.setsockopt(socket.SOL_SOCKET, option, WANTED)
            sizes.append(probe.getsockopt(socket.SOL_SOCKET, option) // 2)  # Linux doubles what is asked for
    return judge_buffers(*sizes)


def judge_buffers(rmem_max: int, wmem_max: int) -> CheckResult:
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


def check_own_domain() -> CheckResult:
    """The domain of this shell, which single nodes and `ros2` use."""
    name = "ros_domain_id"
    value = os.environ.get("ROS_DOMAIN_ID")
    try:
        check_domain()
    except InputError as error:
        return CheckResult(name, "warning", f"{error}: only a run with a domain of its own works")
    if not value:
        return CheckResult(name, "ok", "not set: single nodes use 0, a run takes a free one", 0)
    domain = int(value)
    taken = domain in DOMAINS and is_held(domain)
    warning = None
    if taken or domain in domains_with_ports_in_use():
        by = "another run holds this domain" if taken else "other programs are in this domain"
        warning = f"ROS_DOMAIN_ID: {domain}: {by}: a run takes a free one, but single nodes would meet: choose another"
    return warn_if(name, warning, f"{domain}: single nodes use it, a run takes a free one", domain)


def check_free_domains() -> CheckResult:
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
    return CheckResult(name, "ok", f"{free} of {len(DOMAINS)}, with their UDP ports{which}", free)


CHECKS: tuple[Callable[[], CheckResult], ...] = (
    checks.check_python,
    checks.check_cores,
    checks.check_clock,
    checks.check_open_files,
    checks.check_processes,
    checks.check_shared_memory,
    checks.check_logs,
    checks.check_temporary_directory,
    *(check_loopback, check_multicast, check_buffers),
    *(checks.check_rclpy, check_profiles, check_range, check_server, check_peers),
)
NOT_TRIED = "not tried: correct the errors above first"
LATER = (  # each with the checks that it needs to be without an error
    ("middleware", checks.check_middleware, {"rclpy", "temporary_directory"}),
    ("ros_domain_id", check_own_domain, {"temporary_directory"}),
    ("free_domains", check_free_domains, {"temporary_directory"}),
)


def examine() -> Iterator[CheckResult]:
    """Make one check after the other; the last ones are not tried where an error before says more."""
    failed: set[str] = set()
    for name, make, needed in (*(("", check, set[str]()) for check in CHECKS), *LATER):
        found = CheckResult(name, "warning", NOT_TRIED) if needed & failed else make()
        if found.status == "error":
            failed.add(found.name)
        yield found
    yield CheckResult("round_trip", "warning", NOT_TRIED) if failed else check_round_trip()
