# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Fast DDS profiles, and the participant numbers that go with them."""

from __future__ import annotations

import contextlib
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from msg_analysis.common.version import ros_distribution


def has_fast_dds_3(distribution: str) -> bool:
    """Whether a ROS 2, by its name, comes with Fast DDS 3 or newer: from Kilted on; they are named alphabetically."""
    return distribution > "jazzy"


# Fast DDS 3 refuses a profile with an element that it has renamed, and Fast DDS 2 one with the new name.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # old name, new name
_PLACE = Path(__file__).parent / ("fast_dds_3" if has_fast_dds_3(ros_distribution()) else "")
LOOPBACK_PROFILE = _PLACE / "loopback.xml"
MOST_PARTICIPANTS = 100  # that find each other in a domain on one machine: maxInitialPeersRange of loopback.xml
RELAYED_PROFILE = _PLACE / "introduced.xml"
FIRST_RELAYED = 32  # participantID of introduced.xml; the numbers below are left to all others
MOST_RELAYED = 206  # participants that are introduced to each other: they fill the ports of two domains
NUMBERS_OF_DOMAIN = 119  # of participants whose ports are those of their domain; from there on, of the next one
UDP_PROFILE = Path(__file__).with_name("udp.xml")

LEASE = 60.0
"""s of silence after which a participant on another host counts as gone, and messages on their way to it are lost: the
longest time for which a host may be cut off."""

ANNOUNCEMENT = 3.0  # s between two announcements of a participant to other hosts
_NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"


def has_profile_for(topic: str) -> bool:
    """Whether the profile of this process, if there is one, says something of a topic, by its resolved name."""
    for variable in PROFILE_VARIABLES:
        with contextlib.suppress(OSError, ET.ParseError):
            tree = ET.parse(os.environ.get(variable, ""))
            return tree.find(f".//{{*}}data_writer[@profile_name='{topic}']") is not None
    return False


def domains_for(participants: int) -> int:
    """How many domains in a row have the ports of so many participants that are introduced to each other."""
    return -(-(FIRST_RELAYED + participants) // NUMBERS_OF_DOMAIN)


def profile_for_hosts(
    addresses: Sequence[str] = (),  # of all hosts, at which participants are looked for; empty: by multicast
    participants: int = MOST_PARTICIPANTS,  # to look for at each address
    *,
    lease: float = LEASE,  # s
) -> str:
    """A profile, as XML, for participants on several hosts: UDP at all their interfaces."""
    ET.register_namespace("", _NAMESPACE)
    tree = ET.parse(LOOPBACK_PROFILE)  # drops its comments, which are about another profile

    def find(path: str) -> ET.Element:
        found = tree.find(f".//{{*}}{path.replace('/', '/{*}')}")
        assert found is not None, path
        return found

    find("maxInitialPeersRange").text = str(participants)
    find("transport_descriptor").remove(find("interfaceWhiteList"))  # messages go to other hosts
    for each in find("profiles").findall("./*"):
        if each.get("profile_name", "").startswith("/"):  # batches stay small: a link that loses parts loses the whole
            find("profiles").remove(each)
    discovery = ET.Element(_tag("discovery_config"))
    find("builtin").insert(0, discovery)
    for key, seconds in (("leaseDuration", lease), ("leaseAnnouncement", ANNOUNCEMENT)):
        ET.SubElement(ET.SubElement(discovery, _tag(key)), _tag("sec")).text = f"{seconds:.0f}"
    peers = find("initialPeersList")
    peers.clear()
    for address in addresses:
        locator = ET.SubElement(ET.SubElement(peers, _tag("locator")), _tag("udpv4"))
        ET.SubElement(locator, _tag("address")).text = address
    if not addresses:
        find("builtin").remove(peers)
    ET.indent(tree, "  ")
    return ET.tostring(tree.getroot(), encoding="unicode", xml_declaration=True) + "\n"


def _tag(name: str) -> str:
    return f"{{{_NAMESPACE}}}{name}"
