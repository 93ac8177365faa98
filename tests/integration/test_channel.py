"""Networks over a channel: hosts as network namespaces, with loss and delay between them."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from namespaces import give_up_rights
from scipy import stats

from msg_agents.channel.process import open_hosts
from msg_analysis.bags.reading import read_bag
from msg_analysis.errors import NotAvailableError

THREE = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
# 20,000 steps: no test waits for them; of states that are soon seen in the bag
ENDLESS = {"graphs": THREE, "run": {"duration": 1000, "replicas": 64}}
LEVEL = 1e-6  # false-alarm rate of the test of a loss; the losses have a fixed seed, the numbers of packets do not
MARK_OF_TESTS = b"MSG_AGENTS_TEST="
PROGRAM = Path(sys.executable).with_name("msg-agents")


@pytest.fixture(autouse=True)
def _rights() -> None:
    try:
        with open_hosts(["trial"], 1500):
            pass
    except NotAvailableError as error:
        pytest.skip(f"no rights for a channel: {error}")


def channel_file(network: Any, **document: Any) -> Path:
    path = Path(network.directory / "channel.yaml")
    path.write_text(yaml.safe_dump(document))
    return path


def start(network: Any, changes: dict[str, Any], *options: str, **channel: Any) -> subprocess.Popen[str]:
    file = network.file(**changes)
    arguments = ("--out", network.directory / "runs", "--json", *options, "--channel", channel_file(network, **channel))
    return network.start("run", file, *arguments)


def namespaces(network: Any) -> set[int]:
    """Inodes of the network namespaces of the test's processes, without ours."""
    own = Path("/proc/self/ns/net").stat().st_ino
    found = set()
    for process in network.nodes():
        try:
            found.add(Path(f"/proc/{process.pid}/ns/net").stat().st_ino)
        except OSError:
            continue
    return found - {own}


def holders(inodes: set[int], mark: str) -> list[str]:
    """What still holds one of these namespaces: a process in it, or a descriptor of it."""
    # Not a process of another test: the kernel gives the number of a removed namespace to a new one.
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            marks = [word for word in (entry / "environ").read_bytes().split(b"\0") if word.startswith(MARK_OF_TESTS)]
        except OSError:
            continue
        if marks and marks != [MARK_OF_TESTS + mark.encode()]:
            continue
        for link in (entry / "ns/net", *(entry / "fd").glob("*")):
            try:
                target = str(link.readlink())
            except OSError:
                continue
            if target in {f"net:[{inode}]" for inode in inodes}:
                found.append(str(link))
    return found


@pytest.fixture
def hosts(network: Any) -> Iterator[set[int]]:
    """Namespaces of a channel of three agents, noted by a test; at its end, nothing holds them: they are removed."""
    noted: set[int] = set()
    yield noted
    network.wait_for(lambda: not network.processes(), 30, "the end of all processes")
    assert len(noted) == 4
    assert holders(noted, network.mark) == []


def wait_for_steps(network: Any, hosts: set[int]) -> None:
    network.wait_for_steps()
    hosts |= namespaces(network)


def totals(result: dict[str, Any], what: str) -> int:
    return sum(pair[what] for pair in result["channel"]["pairs"])


def pairs_of(result: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    return {(pair["sender"], pair["receiver"]): pair for pair in result["channel"]["pairs"]}


def test_lockstep_over_a_bad_channel_equals_the_twin(network: Any) -> None:
    """Losses are repaired, so that only the time differs; they are as frequent as the file says."""
    run = start(network, {"run": {"duration": 1}}, seed=3, default={"loss": 0.1, "delay_ms": 1, "jitter_ms": 0.5})
    result = network.completed(run)
    assert result["verdict"] is not None
    channel = result["channel"]
    assert list(channel["hosts"]) == ["base", *(f"agent_{i}" for i in range(1, 6))]
    assert channel["hosts"]["agent_2"] == {"address": "10.77.0.3", "agents": [2]}
    assert len(channel["pairs"]) == 30
    assert all(pair["sent"] and pair["bytes"] >= 28 * pair["sent"] for pair in channel["pairs"])
    assert stats.binomtest(totals(result, "lost"), totals(result, "sent"), 0.1).pvalue > LEVEL
    assert (totals(result, "dropped"), totals(result, "cut"), channel["overflowed"]) == (0, 0, 0)
    page = Path(result["report"]).read_text()
    assert "Packets of each pair of hosts" in page
    assert f"<td>agent_1</td><td>agent_2</td><td>{channel['pairs'][6]['sent']}</td>" in page


@pytest.mark.timeout(150)
def test_real_time_over_a_bad_channel(network: Any) -> None:
    """Old values are used where new ones are lost; nothing is missing in the log."""
    run = start(
        network,
        {"run": {"duration": 3, "pace": "realtime", "processes": 1}},
        "--write-report",
        "never",
        hosts={"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}},
        default={"loss": 0.4, "burst": 3, "delay_ms": 2},
        recorder="clean",
    )
    result = network.completed(run)
    assert read_bag(result["bag"]).used is not None
    pairs = pairs_of(result)
    assert pairs["left", "right"]["lost"] > 0
    assert any(line.startswith("Of the messages between agents, ") for line in result["channel"]["findings"])
    assert pairs["base", "right"]["lost"] == pairs["left", "base"]["lost"] == 0


def assert_active_links_only(result: dict[str, Any]) -> None:
    pairs = pairs_of(result)
    assert pairs["agent_1", "agent_3"]["cut"] > 0  # by no link in any graph: multicast only
    assert pairs["agent_1", "agent_2"]["cut"] == 0  # in both graphs
    assert all(pairs["base", f"agent_{i}"]["cut"] == pairs[f"agent_{i}", "base"]["cut"] == 0 for i in range(1, 6))


def test_real_time_where_only_active_links_carry_packets(network: Any) -> None:
    """The rate of one of them is too low, which is named."""
    slow = {"sender": "agent_1", "receiver": "agent_2", "rate_mbit": 0.2, "queue": 0}
    changes = {"run": {"duration": 3, "pace": "realtime"}}
    result = network.completed(start(network, changes, "--no-analyse", graph=True, pairs=[slow]))
    assert_active_links_only(result)
    assert totals(result, "dropped") == pairs_of(result)["agent_1", "agent_2"]["dropped"] > 0
    (line,) = result["channel"]["findings"]
    assert "of the packets from agent_1 to agent_2 were dropped by the full queue" in line


def test_lockstep_where_only_active_links_carry_packets(network: Any) -> None:
    """It goes on all the same: the graph is that of the slowest agent, whose values then reach it."""
    assert_active_links_only(network.completed(start(network, {"run": {"duration": 3}}, "--no-analyse", graph=True)))


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_a_killed_agent_finds_those_to_which_the_graph_cuts_its_link(network: Any, hosts: set[int], pace: str) -> None:
    """On its host; agent 1 hears one of the others in each graph, for longer than the window of the lockstep."""
    graphs = {"first": {"path": [1, 2, 3]}, "second": {"path": [2, 3, 1]}}
    rare = {"generator": [[-0.2, 0.2], [0.2, -0.2]]}
    changes = {"graphs": graphs, "switching": rare, "run": {"duration": 10, "pace": pace}}
    run = start(network, changes, "--no-analyse", graph=True)
    wait_for_steps(network, hosts)
    next(process for process in network.processes("agent") if process.agent == 1).kill()
    assert len(network.completed(run)["restarts"]) == 1


def test_a_killed_channel_ends_the_run(network: Any, hosts: set[int]) -> None:
    run = start(network, ENDLESS, "--no-analyse")
    wait_for_steps(network, hosts)
    (channel,) = network.processes("channel")
    channel.kill()
    stdout, stderr = network.ended(run, 3)
    assert "failed: channel: killed by SIGKILL" in stderr
    result = json.loads(stdout)
    assert totals(result, "sent") > 0
    assert read_bag(result["bag"]).completeness.missing > 0


@pytest.mark.timeout(150)
def test_a_stopped_channel_ends_the_run(network: Any, hosts: set[int]) -> None:
    run = start(network, ENDLESS, "--no-analyse")
    wait_for_steps(network, hosts)
    (channel,) = network.processes("channel")
    channel.kill(signal.SIGSTOP)
    _, stderr = network.ended(run, 3)
    assert "no report from channel" in stderr
    assert "failed: channel: no report for 10 s, as if it was stopped" in stderr


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_run_leaves_nothing_behind(network: Any, hosts: set[int], number: signal.Signals) -> None:
    run = start(network, ENDLESS, "--no-analyse")
    wait_for_steps(network, hosts)
    run.send_signal(number)
    run.communicate(timeout=60)
    assert run.returncode == (3 if number == signal.SIGINT else -signal.SIGKILL)
    if number == signal.SIGKILL:
        network.wait_for(lambda: not network.processes(), 60, "the end of all that it has started")
        network.traces.clear()  # whoever runs the next network clears its folder away


def test_without_rights_nothing_is_started(network: Any) -> None:
    """In a user namespace that gives none: one line that says what to do."""
    arguments = ["run", network.file(), "--out", network.directory / "runs", "--channel", channel_file(network)]
    done = subprocess.run(
        [str(PROGRAM), *arguments], capture_output=True, text=True, timeout=60, preexec_fn=give_up_rights
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error:"))
    assert line.startswith("error: --channel: no right to make network namespaces and TUN devices")
    assert "run it as root, or in namespaces of your own: `unshare --user --map-root-user --net msg-agents run" in line
    assert not list((network.directory / "runs").glob("*"))


def test_a_limited_rate(network: Any) -> None:
    """Where users can make namespaces, without rights: by the command that the error names."""
    # It is run in one namespace more, in which the user is not root.
    unshared = ["unshare", "--user", "--map-root-user", "--net"]
    possible = subprocess.run([*unshared, "true"], capture_output=True).returncode == 0
    hosts = {"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}}
    file = channel_file(network, hosts=hosts, default={"rate_mbit": 2, "queue": 1000})
    experiment = network.file(run={"duration": 3, "processes": 1})
    options = ("--no-analyse", "--no-fork", "--json", "--out", network.directory / "runs", "--channel", file)
    command = [*(unshared if possible else []), PROGRAM, "run", experiment, *options]
    result = network.completed(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    assert totals(result, "queued") > 0
    assert result["channel"]["findings"] == []
    if not possible:
        pytest.skip("this machine does not let users make namespaces: run with the rights of the tests")
