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

"""Variables by which processes find each other, or are kept from it."""

from __future__ import annotations

import os
from pathlib import Path

from msg_agents.discovery.profiles import PROFILE_VARIABLES
from msg_agents.doctor.check import Check, refusal, warn_if
from msg_agents.processes.environment import (
    LOCALHOST_VARIABLE,
    RANGE_VARIABLE,
    SERVER_VARIABLE,
    TRANSPORTS_VARIABLE,
    node_environment,
    require_discovery,
)
from msg_agents.processes.process_plan import MOST_UNAIDED

VARIABLES_FILE = "FASTDDS_ENVIRONMENT_FILE"
NOT_USED = (TRANSPORTS_VARIABLE, "CYCLONEDDS_URI")  # with the run's own profile of Fast DDS
PEERS_VARIABLE = "ROS_STATIC_PEERS"
RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
UNAIDED = f"its processes look for each other, at most {MOST_UNAIDED} with agents"


def check_profiles() -> Check:
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


def check_range() -> Check:
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


def check_server() -> Check:
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


def check_peers() -> Check:
    """Other machines that are named."""
    peers = os.environ.get(PEERS_VARIABLE)
    alone = os.environ.get(RANGE_VARIABLE, "LOCALHOST") == "LOCALHOST"
    warning = None
    if peers and not alone:
        warning = f"{PEERS_VARIABLE}: {peers}: nodes of a run contact these machines: unset it, or {RANGE_VARIABLE}"
    return warn_if("static_peers", warning, f"{peers} (not used by a run on this machine)" if peers else "none")
