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

"""What the processes of a run find around them: a ROS domain, an environment, and who introduces them to each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from msg_agents.discovery.introducer import Introducer
from msg_agents.discovery.loopback import require_loopback
from msg_agents.discovery.profiles import INTRODUCED_PROFILE, PROFILE_VARIABLES, domains_for
from msg_agents.discovery.ros_domain import free_domain
from msg_agents.processes.environment import node_environment, other_logs, require_discovery
from msg_agents.processes.shared_memory import require_shared_memory

ROS_LOGS = "ros"  # folder for nodes that have no other place for the log files of ROS


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Of one run."""

    domain: int
    environment: dict[str, str]
    introducer: Introducer | None  # None: the processes look for each other, by the user's profile for example


@contextmanager
def surroundings(
    folder: Path,  # of the run
    domain: int | None,  # None: a free one
    changes: Mapping[str, str],  # of the environment
    participants: int,  # of the run
) -> Iterator[Surroundings]:
    """Provide them for a run; InputError: no domain is free, or processes could not meet."""
    with ExitStack() as stack:
        if domain is None:
            domain = stack.enter_context(free_domain(domains_for(participants)))
        environment = node_environment(domain, INTRODUCED_PROFILE) | dict(changes)
        introducer = None
        if will_introduce(changes):
            require_loopback()
            try:
                introducer = stack.enter_context(Introducer(domain))
            except OSError:  # many others are in this domain
                environment = node_environment(domain) | dict(changes)
        require_discovery(environment)
        require_shared_memory()
        environment |= other_logs(folder / ROS_LOGS)
        yield Surroundings(domain, environment, introducer)


def will_introduce(changes: Mapping[str, str]) -> bool:
    """Whether the middleware will follow our profile: not if that of the user, or of several hosts, is used."""
    environment = node_environment(0, INTRODUCED_PROFILE) | dict(changes)
    ours = environment.get(PROFILE_VARIABLES[-1]) == str(INTRODUCED_PROFILE)
    return ours and environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps").startswith("rmw_fastrtps")
