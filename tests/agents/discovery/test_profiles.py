"""The profiles: those for Fast DDS 3 say the same, and the middleware here reads its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from msg_agents.discovery import profiles
from msg_agents.discovery.profiles import INTRODUCED_PROFILE, LOOPBACK_PROFILE, UDP_PROFILE, has_fast_dds_3
from msg_agents.discovery.ros_domain import free_domain
from msg_agents.processes.environment import PROFILE_VARIABLES, node_environment, profile_variables

OLD, NEW = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
FOLDER = Path(profiles.__file__).parent
# All that the profiles have and Fast DDS 3 has renamed: its profiles are made by
#     cd msg_agents/msg_agents/discovery
#     for i in loopback introduced; do sed s/heartbeatPeriod/heartbeat_period/ $i.xml > fast_dds_3/$i.xml; done
RENAMED = ("heartbeatPeriod", "heartbeat_period")


@pytest.mark.parametrize("name", ["loopback.xml", "introduced.xml"])
def test_profiles_for_fast_dds_3_differ_in_what_it_has_renamed(name: str) -> None:
    assert (FOLDER / "fast_dds_3" / name).read_text() == (FOLDER / name).read_text().replace(*RENAMED)


@pytest.mark.parametrize("distribution", ["", "humble", "jazzy"])
def test_up_to_jazzy_the_old_variable_is_read(distribution: str) -> None:
    assert not has_fast_dds_3(distribution)
    assert profile_variables(Path("/p.xml"), distribution) == {OLD: "/p.xml", NEW: "/p.xml"}


@pytest.mark.parametrize("distribution", ["kilted", "lyrical", "rolling"])
def test_from_kilted_on_the_old_variable_gives_a_warning(distribution: str) -> None:
    assert has_fast_dds_3(distribution)
    assert profile_variables(Path("/p.xml"), distribution) == {NEW: "/p.xml"}


@pytest.mark.parametrize("profile", [LOOPBACK_PROFILE, INTRODUCED_PROFILE, UDP_PROFILE], ids=lambda path: path.stem)
def test_the_middleware_here_takes_it(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It prints what it does not understand and goes on without the profile."""
    pytest.importorskip("rclpy")
    for name in (*PROFILE_VARIABLES, "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"):
        monkeypatch.delenv(name, raising=False)
    code = "import rclpy; rclpy.init(); rclpy.create_node('reads_a_profile'); rclpy.shutdown()"
    with free_domain() as domain:
        node = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-c", code],
            env=os.environ | node_environment(domain, profile),
            capture_output=True,
            text=True,
            check=False,
        )
    assert (node.returncode, node.stdout, node.stderr) == (0, "", "")


@pytest.mark.parametrize("value", ["0", "1"])
def test_the_older_variable_for_this_machine_does_not_reach_the_nodes(
    value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 1 they would have shared memory in spite of the profile."""
    for name in (*PROFILE_VARIABLES, "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", value)
    environment = node_environment(0)
    assert "ROS_LOCALHOST_ONLY" not in environment
    assert environment[NEW].endswith("loopback.xml")
