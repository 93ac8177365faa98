"""The doctor on a healthy machine, and on ones that are made ill: it finds what a run then stumbles over."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import namespaces
import pytest

from msg_agents.discovery.rtps import LOOPBACK_PROFILE, free_domain

NAMES = [
    *("python", "cores", "clock", "open_files", "processes", "shared_memory", "home", "temporary_directory"),
    *("loopback", "multicast", "socket_buffers", "rclpy", "profiles", "discovery_range", "discovery_server"),
    *("static_peers", "middleware", "ros_domain_id", "free_domains", "round_trip"),
]
OF_MACHINE = {*NAMES[:10], "socket_buffers", "rclpy", "free_domains"}


def examined(process: Any) -> tuple[int, dict[str, Any]]:
    """Exit code, and the document with its checks by name."""
    stdout, stderr = process.communicate(timeout=60)
    assert stderr == ""
    document = json.loads(stdout)
    checks = {check["name"]: check for check in document["checks"]}
    assert list(checks) == NAMES
    statuses = [check["status"] for check in checks.values()]
    assert document["errors"] == statuses.count("error")
    assert document["warnings"] == statuses.count("warning")
    assert document["can_run"] == (process.returncode == 0) == ("error" not in statuses)
    return process.returncode, checks


@pytest.fixture
def plain_shell(network: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in ("ROS_DISCOVERY_SERVER", "ROS_LOCALHOST_ONLY", "RMW_IMPLEMENTATION", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    return network


def test_healthy(plain_shell: Any) -> None:
    """Nothing is found, and a message goes there and back."""
    code, checks = examined(plain_shell.start("doctor", "--json"))
    ill = {name for name, check in checks.items() if check["status"] != "ok"}
    assert ill <= OF_MACHINE
    if ill:
        pytest.skip(f"this machine: {'; '.join(checks[name]['text'] for name in ill)}")
    assert code == 0
    assert 0 < checks["round_trip"]["value"] < 10


def other_rclpy(folder: Path) -> Path:
    """Of another ROS 2, which cannot be loaded: the folder for PYTHONPATH."""
    package = folder / "lib/python3.9/site-packages/rclpy"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('libpython3.9.so: not found')")
    return package.parent


def test_many_warnings(plain_shell: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """All at once, each on a line of its own; a run can work all the same, as the round trip shows."""
    monkeypatch.delenv("HOME")
    monkeypatch.delenv("ROS_LOG_DIR", raising=False)
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "127.0.0.1:11811")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(other_rclpy(tmp_path).parents[2]))
    with free_domain() as held:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(held))
        doctor = plain_shell.start("doctor", first=namespaces.some_descriptors)
        stdout, stderr = doctor.communicate(timeout=60)
    assert (doctor.returncode, stderr) == (0, "")
    *lines, last = stdout.splitlines()
    found = {line[9:30].rstrip().replace(" ", "_"): line[:9].rstrip() for line in lines}
    assert list(found) == NAMES
    warned = {name for name, status in found.items() if status == "warning"}
    assert warned >= {"open_files", "home", "rclpy", "discovery_server", "ros_domain_id"}
    assert re.fullmatch(r"A run can work here \(\d+ warnings\)\.", last)
    assert found["round_trip"] == "ok"


def test_a_foreign_profile(plain_shell: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One that lets nodes meet: the run works with it."""
    profile = tmp_path / "mine.xml"
    profile.write_text(LOOPBACK_PROFILE.read_text())
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    code, checks = examined(plain_shell.start("doctor", "--json"))
    assert checks["profiles"]["status"] == "warning"
    assert str(profile) in checks["profiles"]["text"]
    assert (code, checks["round_trip"]["status"]) == (0, "ok")


def refused(network: Any, name: str, start: Callable[..., Any]) -> str:
    """The doctor has this error, and a run the same, before anything is made."""
    code, checks = examined(start("doctor", "--json"))
    assert (code, checks[name]["status"], checks["round_trip"]["status"]) == (2, "error", "warning")
    run = start("run", network.file(), "--out", network.directory / "runs")
    stdout, stderr = run.communicate(timeout=60)
    assert (run.returncode, stdout) == (2, "")
    assert stderr == f"error: {checks[name]['text']}\n"
    assert list((network.directory / "runs").glob("*")) == []
    return stderr


def test_a_foreign_middleware(plain_shell: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_none_cpp")
    said = refused(plain_shell, "middleware", plain_shell.start)
    words = "RMW_IMPLEMENTATION: rmw_none_cpp: this ROS 2 .*: unset it, or install that middleware"
    assert re.fullmatch(f"error: {words}\n", said)


def test_a_sourced_foreign_ros(plain_shell: Any, tmp_path: Path) -> None:
    other = {"PYTHONPATH": str(other_rclpy(tmp_path)), "ROS_DISTRO": "foxy"}
    said = refused(plain_shell, "middleware", partial(plain_shell.execute, **other))
    words = (
        r"/rclpy: cannot be used \(ImportError: libpython3.9.so: not found\): PYTHONPATH and ROS_DISTRO may lead to "
    )
    assert re.search(words + "another ROS 2: unset them, ", said)


def test_no_discovery(plain_shell: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    refused(plain_shell, "discovery_range", plain_shell.start)


def need_unshare(*words: str) -> None:
    enter = ["unshare", *words, "true"]
    if not shutil.which("unshare") or subprocess.run(enter, capture_output=True).returncode:
        pytest.skip(f"this machine: cannot do {' '.join(enter)} (needs root and unshare)")


def test_a_full_shared_memory(plain_shell: Any) -> None:
    need_unshare("--mount")
    refused(plain_shell, "shared_memory", partial(plain_shell.start, first=namespaces.full_shared_memory))


def test_no_loopback(plain_shell: Any) -> None:
    """A new network namespace has an interface that is down."""
    need_unshare("--net")
    refused(plain_shell, "loopback", partial(plain_shell.start, first=namespaces.no_loopback))


def test_few_descriptors(plain_shell: Any) -> None:
    """Too few for two processes: the round trip says so, without a traceback."""
    code, checks = examined(plain_shell.start("doctor", "--json", first=namespaces.few_descriptors))
    assert (code, checks["round_trip"]["status"]) == (2, "error")
