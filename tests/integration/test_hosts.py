"""A network over three hosts: network namespaces, each with an address of its own, on a bridge in a fourth."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from namespaces import enter_network
from networks import assert_equal_to_twin
from processors import another_processor
from set_clock import SetClock

from msg_agents.discovery.rtps import PROFILE_VARIABLES
from msg_analysis.bags.reading import read_bag

PREFIX = "msga"
NAMES = ("base", "left", "right")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


def clear(prefix: str) -> None:
    """Remove namespaces; what is in them goes with them."""
    for line in subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout.splitlines():
        name = line.split()[0]
        if name.startswith(prefix):
            subprocess.run(["ip", "netns", "delete", name], capture_output=True)


def clear_abandoned() -> None:
    """Namespaces of tests that were killed."""
    for line in subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout.splitlines():
        found = re.match(rf"({PREFIX}([0-9]+)_)", line)
        if found and not Path(f"/proc/{found[2]}").exists():
            clear(found[1])


@dataclass
class Lan:
    """Three hosts, their files, and the means to start processes on them and to cut them off."""

    network: Any
    prefix: str
    hosts_file: Path
    run_file: Path

    def start_all(self, *options: str, left: dict[str, str] | None = None) -> dict[str, Any]:
        """What every host runs; what they leave is in a directory of each; ``left``: variables at the start of one."""
        started = {}
        for name in NAMES:
            command = ("host", self.run_file, self.hosts_file, "--name", name, "--json", *options)
            place = ("--out", self.network.directory / name)
            if name == "left" and left:
                enter = ("ip", "netns", "exec", self.prefix + name)
                started[name] = self.network.execute(*command, *place, machine=enter, **left)
            else:
                enter_it = partial(enter_network, Path("/run/netns", self.prefix + name))
                started[name] = self.network.start(*command, *place, first=enter_it)
        return started

    def plug(self, host: str, state: str, *, cable: bool) -> None:
        """Set a host's interface, or the port of the bridge that its cable is in, up or down."""
        where, device = ("switch", host) if cable else (host, "eth0")
        ip("-n", self.prefix + where, "link", "set", device, state)


@pytest.fixture
def lan(network: Any) -> Iterator[Lan]:
    if os.geteuid() != 0:
        pytest.skip("run as root: only root can make network namespaces")
    if shutil.which("ip") is None:
        pytest.skip("no command ip: install it (Debian: apt-get install iproute2)")
    clear_abandoned()
    prefix = f"{PREFIX}{os.getpid()}_"
    try:
        try:
            ip("netns", "add", prefix + "switch")
            ip("-n", prefix + "switch", "link", "add", "bridge", "type", "bridge")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"this machine: no network namespaces or bridges: {error.stderr.strip()}")
        ip("-n", prefix + "switch", "link", "set", "bridge", "up")
        for number, name in enumerate(NAMES, start=1):
            ip("netns", "add", prefix + name)
            ip("-n", prefix + "switch", "link", "add", name, "type", "veth", "peer", "name", "eth0",
               "netns", prefix + name)  # fmt: skip
            ip("-n", prefix + "switch", "link", "set", name, "master", "bridge", "up")
            ip("-n", prefix + name, "address", "add", f"10.77.0.{number}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                ip("-n", prefix + name, "link", "set", device, "up")
        hosts = {
            "base": {"address": "10.77.0.1"},
            "left": {"address": "10.77.0.2", "agents": [1, 4]},
            "right": {"address": "10.77.0.3", "agents": ["2-3", 5]},
        }
        hosts_file = network.directory / "hosts.yaml"
        hosts_file.write_text(yaml.safe_dump({"domain": 42, "recorder": "base", "hosts": hosts}))
        yield Lan(network, prefix, hosts_file, network.directory / "run.json")
    finally:
        for process in network.processes():
            process.kill()
        clear(prefix)


def prepare(lan: Lan, duration: float, **changes: Any) -> None:
    """The run record, made once for all hosts."""
    run = {"duration": duration, **changes.pop("run", {})}
    prepared, _ = lan.network.start("prepare", lan.network.file(**changes, run=run)).communicate(60)
    lan.run_file.write_text(prepared)


def ended(processes: dict[str, Any], code: int, timeout: float = 90) -> dict[str, tuple[str, str]]:
    texts = {name: process.communicate(timeout=timeout) for name, process in processes.items()}
    assert {name: process.returncode for name, process in processes.items()} == dict.fromkeys(NAMES, code), texts
    assert not any("Traceback" in text for pair in texts.values() for text in pair), texts
    return texts


ONE_PER_AGENT = {"left": {"agent_1", "agent_4"}, "right": {"agent_2", "agent_3", "agent_5"}}
ONE_PER_HOST = {"left": {"agents_1_and_1_more"}, "right": {"agents_2_and_2_more"}}


def whole(lan: Lan, texts: dict[str, tuple[str, str]], processes: dict[str, set[str]] = ONE_PER_AGENT) -> None:
    """All is there, once, and as the twin says. One bag, on the recorder's host; logs everywhere."""
    results = {name: json.loads(stdout) for name, (stdout, _) in texts.items()}
    assert all(result["failures"] == [] for result in results.values())
    assert [result["bag"] is None for result in results.values()] == [False, True, True]
    trajectory = read_bag(results["base"]["bag"])
    assert trajectory.record.run.hex == json.loads(lan.run_file.read_text())["run"].replace("-", "")
    assert_equal_to_twin(trajectory)
    logs = {name: {log.stem for log in (lan.network.directory / name).glob("*/log/*.log")} for name in NAMES}
    assert logs == {"base": {"recorder", "switcher"}, **processes}


def test_hosts_of_unlike_processors(lan: Lan) -> None:
    """In discrete time, where W is an exponential, and with a start that is drawn."""
    switching = {"transition": [[0.9, 0.1], [0.4, 0.6]]}
    prepare(lan, 500, time="discrete", switching=switching, run={"dt": 1, "processes": 1})
    whole(lan, ended(lan.start_all("--no-analyse", left=another_processor()), 0), ONE_PER_HOST)


def test_a_host_is_cut_off_for_five_seconds(lan: Lan, repetition: int, rng: random.Random) -> None:
    """Its cable is pulled, or its interface goes down: everybody waits, then all goes on, and nothing is lost."""
    # The demo network across three hosts equals the twin to the last bit, and agrees with the prediction.
    prepare(lan, 150)
    host, cable = rng.choice(NAMES), rng.random() < 0.5
    hosts = lan.start_all("--write-report", "never")
    lan.network.wait_until_moving("base")
    time.sleep(rng.uniform(0, 0.5))
    assert all(process.poll() is None for process in hosts.values()), "too fast to be cut off"
    lan.plug(host, "down", cable=cable)
    time.sleep(5)
    assert all(process.poll() is None for process in hosts.values()), (host, cable)
    lan.plug(host, "up", cable=cable)
    texts = ended(hosts, 0)
    whole(lan, texts)
    assert json.loads(texts["base"][0])["verdict"] == "agrees"


@pytest.mark.timeout(300)
def test_a_host_that_leaves_takes_the_others_with_it(lan: Lan) -> None:
    """Ctrl-C on one of them: they say who has gone. Exit code 3 everywhere."""
    # They say so themselves, so nobody waits for a lease of a minute, or for the timeout of the others.
    prepare(lan, 5000)
    hosts = lan.start_all("--no-analyse", "--timeout", "1000")
    lan.network.wait_until_moving("base")
    hosts["left"].send_signal(signal.SIGINT)
    texts = ended(hosts, 3, timeout=50)
    assert "failed: stopped by Ctrl-C\n" in texts["left"][1]
    assert re.search(r"switcher: exit code 2: error: agent_[14](, agent_4)? left the network", texts["base"][1])
    assert re.search(r"agent_[235]: exit code 2: error: switcher left the network", texts["right"][1])
    assert read_bag(json.loads(texts["base"][0])["bag"]).completeness.missing > 0


def rejoined(lan: Lan, patch: pytest.MonkeyPatch, duration: float, run: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """A lease of 3 s instead of a minute; a host is cut off for 7 s, so that both sides have given each other up."""
    prepare(lan, duration, run=run)
    profile, _ = lan.network.start("host", lan.run_file, lan.hosts_file, "--profile").communicate(60)
    for key, before, after in (("leaseDuration", 60, 3), ("leaseAnnouncement", 3, 1)):
        profile, count = re.subn(rf"(<{key}>\s*<sec>){before}<", rf"\g<1>{after}<", profile)
        assert count == 1
    file = lan.network.directory / "short.xml"
    file.write_text(profile)
    setting = dict.fromkeys(PROFILE_VARIABLES, str(file)) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}
    for name, value in setting.items():
        patch.setenv(name, value)
    hosts = lan.start_all("--no-analyse", "--timeout", "60")
    lan.network.wait_until_moving("base")
    assert all(process.poll() is None for process in hosts.values()), "too fast to be cut off"
    lan.plug("left", "down", cable=True)
    time.sleep(7)
    lan.plug("left", "up", cable=True)
    texts = ended(hosts, 0, timeout=120)
    whole(lan, texts)
    return texts


@pytest.mark.timeout(300)
def test_a_host_that_comes_back_after_its_lease_rejoins(lan: Lan, monkeypatch: pytest.MonkeyPatch) -> None:
    rejoined(lan, monkeypatch, 150, {})


@pytest.mark.timeout(300)
def test_a_host_that_comes_back_in_real_time(lan: Lan, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clocks of these hosts are one clock, so 0 is in every interval, and there is no warning."""
    # Fewer and larger messages: soon seen in the bag.
    texts = rejoined(lan, monkeypatch, 18, {"pace": "realtime", "dt": 0.1, "replicas": 32})
    clocks = {name: json.loads(stdout)["clocks"] for name, (stdout, _) in texts.items()}
    assert [entry["node"] for entry in clocks["base"]] == [f"agent_{i}" for i in range(1, 6)]
    assert all(low <= 0 <= high for low, high in (entry["ahead_ms"] for entry in clocks["base"]))
    assert not any("are not that of the switcher" in stderr for _, stderr in texts.values())
    assert clocks["left"] is None


def test_a_clock_that_is_ahead_is_found(lan: Lan) -> None:
    """That of the left host is 200 ms ahead of the others, by a library; dt / speed is 50 ms."""
    clock = SetClock(lan.network.directory)
    clock.set_ahead(0.2)
    prepare(lan, 3, run={"pace": "realtime", "processes": 1})
    texts = ended(lan.start_all("--no-analyse", left=clock.environment), 0)
    for entry in json.loads(texts["base"][0])["clocks"]:
        low, high = entry["ahead_ms"]
        assert low <= (200 if entry["node"] in ("agent_1", "agent_4") else 0) <= high
    assert re.search("note: the clocks of agent_(1(, agent_4)?|4) are not that of the switcher", texts["base"][1])
