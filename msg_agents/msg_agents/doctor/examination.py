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

"""All checks, in order."""

from __future__ import annotations

from collections.abc import Iterator

from msg_agents.doctor import discovery_checks, network_checks, ros_checks, system_checks
from msg_agents.doctor.check import Check
from msg_agents.doctor.round_trip import check_round_trip

OF_SYSTEM = (
    system_checks.check_python,
    system_checks.check_cores,
    system_checks.check_clock,
    system_checks.check_open_files,
    system_checks.check_processes,
    system_checks.check_shared_memory,
    system_checks.check_logs,
    system_checks.check_temporary_directory,
)
OF_NETWORK = (
    network_checks.check_loopback,
    network_checks.check_multicast,
    network_checks.check_buffers,
)
OF_SHELL = (
    ros_checks.check_rclpy,
    discovery_checks.check_profiles,
    discovery_checks.check_range,
    discovery_checks.check_server,
    discovery_checks.check_peers,
)
LATER = (  # each with the checks that it needs to be without an error
    ("middleware", ros_checks.check_middleware, {"rclpy", "temporary_directory"}),
    ("ros_domain_id", network_checks.check_own_domain, {"temporary_directory"}),
    ("free_domains", network_checks.check_free_domains, {"temporary_directory"}),
)


def examine() -> Iterator[Check]:
    """Make one check after the other; the last ones are not tried where an error before says more."""
    failed: set[str] = set()
    for check in (*OF_SYSTEM, *OF_NETWORK, *OF_SHELL):
        found = check()
        failed |= {found.name} if found.status == "error" else set()
        yield found
    for name, make, needed in LATER:
        found = _not_tried(name) if needed & failed else make()
        failed |= {found.name} if found.status == "error" else set()
        yield found
    yield _not_tried("round_trip") if failed else check_round_trip()


def _not_tried(name: str) -> Check:
    return Check(name, "warning", "not tried: correct the errors above first")
