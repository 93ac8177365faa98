"""Checks of the doctor, each with what it is to find planted in this process: variables, limits, sockets, files."""

import resource
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from msg_agents.discovery.rtps import PORT_BASE, PORTS_PER_DOMAIN, domains_with_ports_in_use, free_domain
from msg_agents.doctor import checks, network_checks
from msg_agents.doctor.checks import CheckResult
from msg_agents.environment import require_shared_memory

VARIABLES = (
    *network_checks.PROFILE_VARIABLES,
    *network_checks.NOT_USED,
    network_checks.VARIABLES_FILE,
    network_checks.RANGE_VARIABLE,
    network_checks.SERVER_VARIABLE,
    network_checks.PEERS_VARIABLE,
    network_checks.LOCALHOST_VARIABLE,
    *("ROS_DOMAIN_ID", "ROS_LOG_DIR", "ROS_HOME", "RMW_IMPLEMENTATION"),
)


@pytest.fixture(autouse=True)
def plain_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


def by_variables() -> dict[str, CheckResult]:
    """The checks of variables, by name."""
    names = ("profiles", "range", "server", "peers", "own_domain")
    found = [getattr(network_checks, f"check_{name}")() for name in names]
    return {check.name: check for check in found}


def test_a_plain_shell() -> None:
    assert {check.status for check in by_variables().values()} == {"ok"}


@pytest.mark.parametrize(
    ("variables", "name", "status"),
    [
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "/nowhere.xml"}, "profiles", "warning"),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": __file__}, "profiles", "warning"),
        ({"FASTDDS_ENVIRONMENT_FILE": "/variables.json"}, "profiles", "warning"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "CYCLONEDDS_URI": "file:///c.xml"}, "profiles", "ok"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, "discovery_range", "ok"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "discovery_range", "warning"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"}, "discovery_range", "warning"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "discovery_range", "error"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "discovery_range", "ok"),
        ({"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "discovery_range", "warning"),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, "discovery_server", "warning"),
        ({"ROS_STATIC_PEERS": "10.0.0.1"}, "static_peers", "ok"),
        ({"ROS_STATIC_PEERS": "10.0.0.1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "static_peers", "warning"),
        ({"ROS_DOMAIN_ID": "fifty"}, "ros_domain_id", "warning"),
        ({"ROS_DOMAIN_ID": "232"}, "ros_domain_id", "warning"),
    ],
)
def test_a_variable(monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], name: str, status: str) -> None:
    """Is found, named with its value; where it is not ok, the text ends with what to do."""
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    found = by_variables()[name]
    variable, value = next(iter(variables.items()))
    assert found.status == status
    assert value == "LOCALHOST" or (variable in found.text or status == "ok")
    assert value == "LOCALHOST" or value in found.text
    others = {check.status for check in by_variables().values() if check.name != name}
    assert len(variables) > 1 or others == {"ok"}


def test_a_server_that_a_run_would_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a range of the user's, the environment of the nodes keeps it."""
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "10.0.0.1:11811")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    assert "only while it is there" in network_checks.check_server().text


def test_a_domain_that_a_run_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    with free_domain() as held:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(held))
        assert network_checks.check_own_domain().status == "warning"
        found = network_checks.check_free_domains()
    assert found.status == "ok"
    assert found.value < 101


def test_a_domain_with_a_bound_port(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = max(set(range(102, 200)) - domains_with_ports_in_use())  # no run takes one of these
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as somebody:
        somebody.bind(("127.0.0.1", PORT_BASE + PORTS_PER_DOMAIN * domain + 11))
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        found = network_checks.check_own_domain()
    assert (found.status, "other programs" in found.text) == ("warning", True)


@pytest.mark.parametrize(("limit", "status"), [(64, "warning"), (1023, "warning"), (1024, "ok")])
def test_open_files(limit: int, status: str) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] != resource.RLIM_INFINITY and before[1] < 1024:
        pytest.skip(f"this machine: at most {before[1]} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        found = checks.check_open_files()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert (found.status, found.value) == (status, limit)
    assert status == "ok" or "`ulimit -n 1024`" in found.text


def test_no_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert checks.check_logs().status == "ok"
    monkeypatch.setenv("HOME", "/dev/null/home")
    assert checks.check_logs().status == "warning"
    monkeypatch.delenv("HOME")
    assert "HOME: not set" in checks.check_logs().text
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    assert checks.check_logs().status == "warning"


def test_no_rclpy() -> None:
    """In a Python that finds none, the error is that of a run."""
    code = (
        "import sys\n"
        "from msg_agents.doctor.checks import check_rclpy\n"
        "from msg_agents.environment import require_middleware\n"
        "sys.path[:] = []\n"
        "print(check_rclpy().status)\n"
        "print(check_rclpy().text)\n"
        "require_middleware({})"
    )
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    status, text = process.stdout.splitlines()
    assert (process.returncode, status) == (1, "error")
    assert process.stderr.endswith(f"InputError: {text}\n")
    assert text.startswith(f"rclpy: not found by {sys.executable}: run `make setup`")


@pytest.mark.parametrize(
    ("sizes", "status"),
    [((212_992, 212_992), "ok"), ((4_194_304, 212_992), "ok"), ((4_608, 212_992), "warning"), ((4_608, 2), "warning")],
)
def test_buffers(sizes: tuple[int, int], status: str) -> None:
    found = network_checks.judge_buffers(*sizes)
    assert (found.status, found.value) == (status, sizes[0])
    assert ("net.core.rmem_max=" in found.text) == (sizes[0] < 212_992)
    assert ("net.core.wmem_max=" in found.text) == (sizes[1] < 212_992)


def test_buffers_of_this_machine() -> None:
    """What a socket says that it got, by another way to ask: the limit of the kernel, where it can be read."""
    limit = Path("/proc/sys/net/core/rmem_max")
    if not limit.is_file():
        pytest.skip("this machine: the limit of socket buffers cannot be read")
    assert network_checks.check_buffers().value == min(int(limit.read_text()), network_checks.WANTED)


def test_another_rclpy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of a sourced ROS that does not win."""
    pytest.importorskip("rclpy")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    before = checks.check_rclpy().text
    package = tmp_path / "lib/python3.9/site-packages/rclpy"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    found = checks.check_rclpy()
    assert found.status == "warning"
    assert str(package.resolve()) in found.text
    assert str(package.resolve()) not in before


def test_shared_memory_that_is_not_full(tmp_path: Path) -> None:
    """Or not there at all; tests/integration/test_doctor.py has a full one."""
    require_shared_memory(tmp_path)
    require_shared_memory(tmp_path / "none")
