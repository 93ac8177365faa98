"""The environment of the processes of a run."""

from __future__ import annotations

import os
from pathlib import Path

LOOPBACK_PROFILE = Path(__file__).with_name("loopback.xml")
MOST_PARTICIPANTS = 100  # of a domain that find each other on one machine: maxInitialPeersRange of loopback.xml
RESTARTS = 3  # of killed processes in a run, if nothing else is said
DISCOVERY_TIMEOUT = 30.0  # s for which nodes look for each other, in small networks
PEERS_VARIABLE = "MSG_AGENTS_PEERS"  # addresses of the hosts of a run, where there are several
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # old name, new name


def node_environment(domain: int, profile: Path = LOOPBACK_PROFILE) -> dict[str, str]:
    """Ours with what the nodes need; where the user has chosen another discovery range or profile, that stays.

    Parameters
    ----------
    domain
        ROS_DOMAIN_ID
    profile
        of Fast DDS
    """
    environment = {
        # The arithmetic of one agent is far too small for threads, which would only fight for the cores.
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "PYTHONUNBUFFERED": "1",
        # ``python -m`` would look for msg_agents in the working directory first, and find our source tree's folder.
        "PYTHONSAFEPATH": "1",
    }
    local = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST") == "LOCALHOST"
    if local and not any(environment.get(name) for name in PROFILE_VARIABLES):
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"  # as the profile says
        environment.update(dict.fromkeys(PROFILE_VARIABLES, str(profile)))
    return environment
