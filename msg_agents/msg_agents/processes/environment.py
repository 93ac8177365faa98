"""The environment of the processes of a run."""

from __future__ import annotations

import os
from pathlib import Path

from msg_analysis.errors import InputError

LOOPBACK_PROFILE = Path(__file__).with_name("loopback.xml")
MOST_PARTICIPANTS = 100  # that find each other in a domain on one machine: maxInitialPeersRange of loopback.xml
UDP_PROFILE = Path(__file__).with_name("udp.xml")
TRANSPORTS_VARIABLE = "FASTDDS_BUILTIN_TRANSPORTS"
RESTARTS = 3  # of killed processes in a run, by default
# The arithmetic of one agent is far too small for threads, which would only compete for the cores.
SINGLE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
LAST_DOMAIN = 231  # 232, the last of ROS, has ports for some 60 participants only
DISCOVERY_TIMEOUT = 30.0  # s for which nodes look for each other in small networks
PEERS_VARIABLE = "MSG_AGENTS_PEERS"  # addresses of the hosts, in a run on several
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # old name, new name


def check_domain() -> None:
    """InputError if the environment's ROS_DOMAIN_ID is not usable; to be called before the middleware starts."""
    value = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not value.isdecimal() or int(value) > LAST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID: {value}: expected a number from 0 to {LAST_DOMAIN}")


def discovery_scope() -> str:
    """Where the nodes of this process find others, as text."""
    domain, reach = os.environ.get("ROS_DOMAIN_ID", "0"), os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    return f"in ROS_DOMAIN_ID {domain} and within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}"


def node_environment(domain: int, profile: Path = LOOPBACK_PROFILE) -> dict[str, str]:
    """Our environment with what the nodes need; another discovery range or profile of the user's is kept."""
    environment = {
        **SINGLE_THREAD,
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "PYTHONUNBUFFERED": "1",
        # ``python -m`` would look for msg_agents in the working directory first, and find our source tree's folder.
        "PYTHONSAFEPATH": "1",
    }
    local = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST") == "LOCALHOST"
    if local and not any(environment.get(name) for name in PROFILE_VARIABLES):
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"  # the profile decides
        environment.update(dict.fromkeys(PROFILE_VARIABLES, str(profile)))
    return environment


def without_shared_memory() -> dict[str, str]:
    """Changes to our environment that make the middleware use UDP only; the user's profile or transports are kept.

    A process that ends at once would otherwise leave shared memory behind.
    """
    if any(os.environ.get(name) for name in (*PROFILE_VARIABLES, TRANSPORTS_VARIABLE)):
        return {}
    if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST":  # adds shared memory to any profile
        return {
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
            **dict.fromkeys(PROFILE_VARIABLES, str(LOOPBACK_PROFILE)),
        }
    return dict.fromkeys(PROFILE_VARIABLES, str(UDP_PROFILE))
