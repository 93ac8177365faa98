"""The profiles: those for Fast DDS 3 say the same, and the middleware here reads its own."""

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from msg_agents.discovery import rtps
from msg_agents.discovery.rtps import (
    LOOPBACK_PROFILE,
    PROFILE_VARIABLES,
    RELAYED_PROFILE,
    UDP_PROFILE,
    free_domain,
    has_fast_dds_3,
    has_profile_for,
    profile_for_hosts,
)
from msg_agents.environment import node_environment, profile_variables, run_environment
from msg_analysis.messages.topics import STATES, TRUTHS

OLD, NEW = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
FOLDER = Path(rtps.__file__).parent
# All that the profiles have and Fast DDS 3 has renamed: its profiles are made by
#     cd msg_agents/msg_agents/discovery
#     for i in loopback relayed; do
#         sed -e s/heartbeatPeriod/heartbeat_period/ -e s/initialAcknackDelay/initial_acknack_delay/ $i.xml \
#             > fast_dds_3/$i.xml
#     done
RENAMED = {"heartbeatPeriod": "heartbeat_period", "initialAcknackDelay": "initial_acknack_delay"}


@pytest.fixture(autouse=True)
def plain_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*PROFILE_VARIABLES, "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("name", ["loopback.xml", "relayed.xml"])
def test_profiles_for_fast_dds_3_differ_in_what_it_has_renamed(name: str) -> None:
    old = (FOLDER / name).read_text()
    new = re.sub("|".join(RENAMED), lambda found: RENAMED[found[0]], old)
    assert (FOLDER / "fast_dds_3" / name).read_text() == new


@pytest.mark.parametrize("path", [LOOPBACK_PROFILE, RELAYED_PROFILE], ids=lambda path: path.stem)
def test_who_is_stopped_for_minutes_is_not_dropped(path: Path) -> None:
    (lease,) = ET.parse(path).findall(".//{*}discovery_config/{*}leaseDuration/{*}sec")
    assert int(lease.text or "") >= 30 * 60


@pytest.mark.parametrize("path", [LOOPBACK_PROFILE, RELAYED_PROFILE], ids=lambda path: path.stem)
def test_profiles_of_topics_have_the_times_of_the_others(path: Path) -> None:
    """The profile of a topic is read instead of the default one."""
    for kind in ("data_writer", "data_reader"):
        profiles = ET.parse(path).findall(f".//{{*}}{kind}")
        times = [[*each.iterfind("{*}times/{*}*/{*}nanosec")] for each in profiles]
        assert [each.get("is_default_profile") for each in profiles] == ["true", None, None]
        assert {(each[0].text, len(each)) for each in times} == {(times[0][0].text, 1)}


@pytest.mark.parametrize(
    ("distributions", "names"), [(["", "humble", "jazzy"], [OLD, NEW]), (["kilted", "lyrical", "rolling"], [NEW])]
)
def test_from_kilted_on_the_old_variable_is_not_read(distributions: list[str], names: list[str]) -> None:
    for distribution in distributions:
        assert has_fast_dds_3(distribution) == (OLD not in names)
        assert profile_variables(Path("/p.xml"), distribution) == dict.fromkeys(names, "/p.xml")


@pytest.mark.parametrize("profile", [LOOPBACK_PROFILE, RELAYED_PROFILE, UDP_PROFILE], ids=lambda path: path.stem)
def test_the_middleware_here_takes_it(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It prints what it does not understand and goes on without the profile."""
    pytest.importorskip("rclpy")
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


@pytest.mark.parametrize("variable", PROFILE_VARIABLES)
def test_our_profiles_for_one_machine_bound_the_batches_of_states(
    variable: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """So batches are large with these profiles only."""
    hosts, damaged = tmp_path / "hosts.xml", tmp_path / "damaged.xml"
    hosts.write_text(profile_for_hosts(["10.0.0.1"]))
    damaged.write_text("<dds>")
    assert not has_profile_for("/states")
    for path, bounded in (
        (LOOPBACK_PROFILE, True),
        (RELAYED_PROFILE, True),
        (hosts, False),
        (UDP_PROFILE, False),
        (damaged, False),
        (tmp_path / "missing.xml", False),
    ):
        monkeypatch.setenv(variable, str(path))
        found = [has_profile_for(f"{root}{topic.name}") for topic in (STATES, TRUTHS) for root in ("/", "/network/")]
        assert found == [bounded, False, bounded, False], path


KEPT = """
import sys, rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from msg_agents_interfaces.msg import StateBatch

rclpy.init()
node = rclpy.create_node(sys.argv[1], enable_rosout=False)
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0, reliability=ReliabilityPolicy.RELIABLE)
if sys.argv[1] == "reader":
    reader = node.create_subscription(StateBatch, "states", lambda message: None, qos)
    print(flush=True)
    sys.stdin.read()
else:
    writer = node.create_publisher(StateBatch, "states", qos)
    while not writer.get_subscription_count():
        pass
    kept = 0
    try:
        while kept < 20000:
            writer.publish(StateBatch())
            kept += 1
    except rclpy.impl.implementation_singleton.rclpy_implementation.RCLError:
        pass
    print(kept)
"""


def test_so_many_batches_wait_for_a_reader_that_takes_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the writer, and as many at the reader: both are bounded by the profile (40 MB of batches each)."""
    pytest.importorskip("rclpy")
    command = [sys.executable, "-P", "-W", "ignore", "-c", KEPT]
    with free_domain() as domain:
        environment = os.environ | node_environment(domain, LOOPBACK_PROFILE)
        with subprocess.Popen(
            [*command, "reader"], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as reader:
            reader.stdout.readline()
            writer = subprocess.run([*command, "writer"], env=environment, capture_output=True, text=True, check=True)
            reader.stdin.close()
    from msg_agents.nodes.agent_group import BATCH_SIZE

    kept = int(writer.stdout)
    assert kept == 2 * 680
    assert kept * BATCH_SIZE <= 2 * 41_000_000


@pytest.mark.parametrize("value", ["0", "1"])
def test_the_older_variable_for_this_machine_does_not_reach_the_nodes(
    value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 1 they would have shared memory in spite of the profile."""
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", value)
    environment = node_environment(0)
    assert "ROS_LOCALHOST_ONLY" not in environment
    assert environment[NEW].endswith("loopback.xml")


@pytest.mark.parametrize(
    "name",
    [
        *("RMW_IMPLEMENTATION", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISCOVERY_SERVER", "ROS_LOCALHOST_ONLY"),
        *("ROS_DOMAIN_ID", "FASTDDS_BUILTIN_TRANSPORTS", "OMP_NUM_THREADS", *PROFILE_VARIABLES),
    ],
)
def test_an_empty_variable_is_one_that_is_not_set(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As compose files make it by ``NAME: ${NAME}``."""
    found = []
    for change in (lambda: monkeypatch.delenv(name, raising=False), lambda: monkeypatch.setenv(name, "")):
        change()
        with run_environment(tmp_path, 231, {}, 3) as (_, environment, relay):
            found.append((environment, relay is None))
    assert found[0] == found[1]
    assert not found[0][1]


def test_without_a_relay_no_profile_relies_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    with run_environment(tmp_path, 231, {}, 3) as (_, environment, relay):
        assert relay is None
        assert environment[NEW] == str(LOOPBACK_PROFILE)
