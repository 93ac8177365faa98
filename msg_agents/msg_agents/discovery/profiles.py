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

"""Fast DDS profiles, and the participant numbers that go with them."""

from __future__ import annotations

from pathlib import Path

from msg_analysis.common.version import ros_distribution


def has_fast_dds_3(distribution: str) -> bool:
    """Whether a ROS 2, by its name, comes with Fast DDS 3 or newer: from Kilted on; they are named alphabetically."""
    return distribution > "jazzy"


# Fast DDS 3 refuses a profile with an element that it has renamed, and Fast DDS 2 one with the new name.
_PLACE = Path(__file__).parent / ("fast_dds_3" if has_fast_dds_3(ros_distribution()) else "")
LOOPBACK_PROFILE = _PLACE / "loopback.xml"
MOST_PARTICIPANTS = 100  # that find each other in a domain on one machine: maxInitialPeersRange of loopback.xml
INTRODUCED_PROFILE = _PLACE / "introduced.xml"
FIRST_INTRODUCED = 32  # participantID of introduced.xml; the numbers below are left to all others
MOST_INTRODUCED = 206  # participants that are introduced to each other: they fill the ports of two domains
NUMBERS_OF_DOMAIN = 119  # of participants whose ports are those of their domain; from there on, of the next one
UDP_PROFILE = Path(__file__).with_name("udp.xml")


def domains_for(participants: int) -> int:
    """How many domains in a row have the ports of so many participants that are introduced to each other."""
    return -(-(FIRST_INTRODUCED + participants) // NUMBERS_OF_DOMAIN)
