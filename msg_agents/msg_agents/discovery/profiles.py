"""Fast DDS profiles, and the participant numbers that go with them."""

from __future__ import annotations

from pathlib import Path

LOOPBACK_PROFILE = Path(__file__).with_name("loopback.xml")
MOST_PARTICIPANTS = 100  # that find each other in a domain on one machine: maxInitialPeersRange of loopback.xml
INTRODUCED_PROFILE = Path(__file__).with_name("introduced.xml")
FIRST_INTRODUCED = 32  # participantID of introduced.xml; the numbers below are left to all others
MOST_INTRODUCED = 206  # participants that are introduced to each other: they fill the ports of two domains
NUMBERS_OF_DOMAIN = 119  # of participants whose ports are those of their domain; from there on, of the next one
UDP_PROFILE = Path(__file__).with_name("udp.xml")


def domains_for(participants: int) -> int:
    """How many domains in a row have the ports of so many participants that are introduced to each other."""
    return -(-(FIRST_INTRODUCED + participants) // NUMBERS_OF_DOMAIN)
