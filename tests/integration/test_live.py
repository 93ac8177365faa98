"""A network that is watched, running or played, by a process of its own."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from awaiting_network import BAG, failures_of, network_awaiting

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.inference.pool import compare
from msg_analysis.twin.simulate import new_record, simulate

LISTENER = """
import json
import rclpy
from msg_agents_interfaces.msg import Estimate
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
rclpy.init()
node = rclpy.create_node("listener")
found = []
qos = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
estimate = node.create_subscription(Estimate, "estimate", found.append, qos)
while not estimate.get_publisher_count():
    rclpy.spin_once(node, timeout_sec=0.1)
print("matched", flush=True)
while not found or found[-1].steps < 300:
    rclpy.spin_once(node, timeout_sec=1.0)
last = found[-1]
system = [last.system_error, last.system_predicted, last.system_standard_error]
stamp = [last.header.stamp.sec, last.header.stamp.nanosec]
print(json.dumps([bytes(last.run).hex(), last.first_step, last.last_step, *system, list(last.node_errors), *stamp]))
"""


def ended(process: subprocess.Popen[str], code: int = 0) -> tuple[str, str]:
    stdout, stderr = process.communicate(timeout=90)
    assert process.returncode == code, stdout + stderr
    assert "Traceback" not in stderr
    return stdout, stderr


def test_a_replay_gives_the_numbers_of_the_comparison(network: Any, domain: int) -> None:
    """To 1e-9, on stdout and on the topic; the same with the bag's own numbers taken from elsewhere."""
    trajectory = simulate(network.experiment(noise={"process": 1.0, "loss": 0.05}))
    bag = network.directory / "bag"
    write_trajectory(trajectory, bag)
    listener = subprocess.Popen([sys.executable, "-P", "-c", LISTENER], stdout=subprocess.PIPE, text=True)
    live = network.start("live", "--reliable", "--json", "--timeout", "60")
    assert listener.stdout
    assert listener.stdout.readline() == "matched\n"
    ended(network.start("play", bag, "--rate", "10", "--await", "live"))
    stdout, _ = ended(live)
    found, wanted = json.loads(stdout), compare(read_bag(bag)).to_json()
    heard = json.loads(listener.communicate(timeout=60)[0])
    assert (found["run"], found["experiment"], found["refused"]) == (wanted["run"], "net", {})
    assert (found["first_step"], found["last_step"], found["steps"], found["missing"]) == (0, 299, 300, 0)
    for ours, theirs in zip(
        [found["system_error"], *found["node_errors"]], [wanted["system_error"], *wanted["node_errors"]], strict=True
    ):
        for key in ("measured", "predicted", "standard_error", "z", "p"):
            assert ours[key] == pytest.approx(theirs[key], rel=1e-9), key
    assert heard[:3] == [trajectory.record.run.hex, 0, 299]
    system = wanted["system_error"]
    assert heard[3:6] == pytest.approx([system[key] for key in ("measured", "predicted", "standard_error")], rel=1e-9)
    assert heard[6] == pytest.approx([node["measured"] for node in wanted["node_errors"]], rel=1e-9)
    assert heard[7:] == [14, 950_000_000]


@pytest.mark.parametrize("option", ["--bag", "--experiment"])
def test_a_replay_without_its_start_is_known_from_a_file(network: Any, domain: int, option: str) -> None:
    """As with `ros2 bag play --start-offset`: no latched topic is played, and it is there before there is a player."""
    trajectory = simulate(network.experiment())
    bag, record = network.directory / "bag", network.directory / "run.json"
    write_trajectory(trajectory, bag)
    record.write_text(trajectory.record.to_json())
    source = bag if option == "--bag" else record
    live = network.start("live", "--reliable", "--json", "--timeout", "60", option, source)
    without = ("--exclude", "/experiment", "--exclude", "/graph")
    ended(network.start("play", bag, *without, "--start-offset", "5", "--rate", "max", "--await", "live"))
    found = json.loads(ended(live)[0])
    assert (found["run"], found["refused"]) == (str(trajectory.record.run), {})
    assert (found["first_step"], found["last_step"], found["steps"], found["missing"]) == (100, 299, 200, 0)
    states = trajectory.states[100:300]  # (steps, agents, replicas)
    error = ((states - states.mean(axis=1, keepdims=True)) ** 2).sum(axis=1).mean()
    assert found["system_error"]["measured"] == pytest.approx(error, rel=1e-9)


def test_files_of_which_no_run_is_known(network: Any) -> None:
    file = network.file()
    for words, message in (
        (["--bag", network.directory], "not a bag: expected metadata.yaml, .mcap or .db3 files"),
        (["--experiment", file], "not a run record (JSONDecodeError"),
        (["--experiment", network.directory / "none.json"], "cannot be read"),
        (["--experiment", file, "--bag", network.directory], "--bag and --experiment: expected at most one of them"),
    ):
        _, stderr = ended(network.start("live", *words), code=2)
        assert message in stderr


def test_a_running_network_is_watched_to_its_end(network: Any, domain: int) -> None:
    """From the first step that it gets whole, it misses none: its number is that of the bag, to every printed digit.

    The run begins when it sees the watcher, and may be over before the watcher reads its states: then once more.
    """
    for attempt in range(3):
        live = network.start("live", "--reliable")
        assert "waiting for one" in live.stderr.readline()
        directory = network.directory / str(attempt)
        directory.mkdir()
        record = new_record(network.experiment(run={"processes": 2, "duration": 250}))
        with network_awaiting("live", record, directory, domain) as nodes:
            network.wait_for(lambda nodes=nodes: not nodes.running or nodes.failures, 90, "the end of the run")
            assert failures_of(nodes) == []
        last = ended(live)[0].splitlines()[-1]
        if "no complete step yet" not in last:
            break
    found = re.fullmatch(
        r"step 5000 of 5000, system error ([\d.]+) .*, (\d+) steps(?: since step (\d+))?, 0 missing, \d+ steps/s",
        last,
    )
    assert found, last
    first = int(found[3] or 0)
    assert first + int(found[2]) == 5000
    trajectory = read_bag(directory / BAG)
    assert trajectory.completeness.complete
    states = trajectory.states[first:5000]  # (steps, agents, replicas)
    error = ((states - states.mean(axis=1, keepdims=True)) ** 2).sum(axis=1).mean()
    assert found[1] == f"{error:.6g}"


def test_a_run_of_which_no_state_comes_is_over(network: Any, domain: int) -> None:
    """It ended before the watcher had found its agents, for example."""
    bag = network.directory / "bag"
    write_trajectory(simulate(network.experiment()), bag)
    live = network.start("live", "--timeout", "60")
    play = network.start("play", bag, "--topics", "/experiment", "--await", "live")
    ended(play)
    stdout, _ = ended(live, code=3)
    assert "no complete step yet" in stdout


@pytest.mark.parametrize("options", [(), ("--reliable",)])
def test_the_player_does_not_wait_for_a_watcher_that_has_left(
    network: Any, domain: int, options: tuple[str, ...]
) -> None:
    """The watcher ends with the run, long before the middleware asks it what it has got."""
    bag = network.directory / "bag"
    write_trajectory(simulate(network.experiment()), bag)
    live = network.start("live", *options)
    _, said = ended(network.start("play", bag, "--rate", "max", "--await", "live"))
    assert "waiting until the readers" not in said
    assert live.wait(60) in (0, 3)  # with best effort it may have missed the last step


def test_a_watcher_that_is_stopped_holds_nobody_up(network: Any, domain: int) -> None:
    """By default nobody waits for it: it misses states, and says how many steps that makes."""
    bag = network.directory / "bag"
    write_trajectory(simulate(network.experiment(run={"duration": 200})), bag)
    live = network.start("live")
    play = network.start("play", bag, "--rate", "25", "--await", "live")
    for _ in range(4):  # by then it has acknowledged the experiment
        wait_for_steps(live)
    live.send_signal(signal.SIGSTOP)
    ended(play)
    live.send_signal(signal.SIGCONT)
    stdout, stderr = live.communicate(timeout=60)
    assert live.returncode in (0, 3), stderr  # it may have missed the last step
    errors = r"system error [\d.]+ ± [\d.]+ \(95 %\), predicted [\d.]+, z = [+-][\d.]+"
    evidence = r"at all times ± [\d.]+, evidence against the prediction [\d.]+ \(threshold 100\)"
    assert re.search(rf"{errors}, {evidence}, \d+ steps", stdout)


def wait_for_steps(live: subprocess.Popen[str]) -> None:
    """Until it has something to say."""
    assert live.stdout
    while " steps" not in (line := live.stdout.readline()):
        assert line, live.communicate()


@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST"])
def test_interrupted_it_says_what_it_has(
    network: Any, domain: int, monkeypatch: pytest.MonkeyPatch, reach: str
) -> None:
    """Exit code 3: not seen to the end. Without any network too. It uses no shared memory, so it leaves none."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", reach)
    bag = network.directory / "bag"
    write_trajectory(simulate(network.experiment()), bag)
    live, play = network.start("live"), network.start("play", bag, "--rate", "0.5", "--await", "live")
    alone = network.start("live", "--domain", "231")
    wait_for_steps(live)
    assert "/dev/shm/fastrtps_" not in Path(f"/proc/{live.pid}/maps").read_text()
    live.send_signal(signal.SIGINT)
    ended(live, 3)
    play.send_signal(signal.SIGINT)
    ended(play, 130)
    assert "waiting for one. Another domain: --domain D" in alone.stderr.readline()
    alone.send_signal(signal.SIGTERM)
    assert "no network was seen" in ended(alone, 3)[1]
    said = ended(network.start("live", "--timeout", "1"), 2)[1]
    assert re.search(
        f"after 1 s no network in ROS_DOMAIN_ID {domain} and within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}", said
    )
