"""Which variables lead the middleware of a distribution to a profile."""

from __future__ import annotations

from pathlib import Path

import pytest

from msg_agents.processes.environment import profile_variables

OLD, NEW = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"


@pytest.mark.parametrize("distribution", ["", "humble", "jazzy"])
def test_the_old_name_is_the_one_that_fast_dds_2_reads(distribution: str) -> None:
    assert profile_variables(Path("/p.xml"), distribution) == {OLD: "/p.xml", NEW: "/p.xml"}


@pytest.mark.parametrize("distribution", ["kilted", "lyrical", "rolling"])
def test_fast_dds_3_warns_of_the_old_name(distribution: str) -> None:
    assert profile_variables(Path("/p.xml"), distribution) == {NEW: "/p.xml"}
