"""A network that is watched, running or played, by a process of its own: its errors, and its picture."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
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


def test_a_replay_gives_the_numbers_of_the_comparison(network: Any, domain: int) -> None:
    """To 1e-9, on stdout and on the topic; the same with the bag's own numbers taken from elsewhere."""
    trajectory = simulate(network.experiment(noise={"process": 1.0, "loss": 0.05}))
    bag = network.directory / "bag"
    write_trajectory(trajectory, bag)
    listener = subprocess.Popen([sys.executable, "-P", "-c", LISTENER], stdout=subprocess.PIPE, text=True)
    live = network.start("live", "--reliable", "--json", "--timeout", "60")
    assert listener.stdout.readline() == "matched\n"
    network.ended(network.start("play", bag, "--rate", "10", "--await", "live"))
    stdout, _ = network.ended(live)
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
    network.ended(network.start("play", bag, *without, "--start-offset", "5", "--rate", "max", "--await", "live"))
    found = json.loads(network.ended(live)[0])
    assert (found["run"], found["refused"]) == (str(trajectory.record.run), {})
    assert (found["first_step"], found["last_step"], found["steps"], found["missing"]) == (100, 299, 200, 0)
    states = trajectory.states[100:300]  # (steps, agents, replicas)
    error = ((states - states.mean(axis=1, keepdims=True)) ** 2).sum(axis=1).mean()
    assert found["system_error"]["measured"] == pytest.approx(error, rel=1e-9)


def test_a_running_network_is_watched_to_its_end(network: Any, domain: int) -> None:
    """From the first step that it gets whole, it misses none: its number is that of the bag, to every printed digit."""
    # The run begins when it sees the watcher, and may be over before the watcher reads its states: then once more.
    for attempt in range(3):
        live = network.start("live", "--reliable")
        assert "waiting for one" in live.stderr.readline()
        directory = network.directory / str(attempt)
        directory.mkdir()
        record = new_record(network.experiment(run={"processes": 2, "duration": 250}))
        with network_awaiting("live", record, directory, domain) as nodes:
            network.wait_for(lambda nodes=nodes: not nodes.running or nodes.failures, 90, "the end of the run")
            assert failures_of(nodes) == []
        last = network.ended(live)[0].splitlines()[-1]
        if "no complete step yet" not in last:
            break
    found = re.fullmatch(
        r"step 5000 of 5000, system error ([\d.]+) .*, (\d+) steps(?: since step (\d+))?, 0 missing, \d+ steps/s", last
    )
    assert found, last
    first = int(found[3] or 0)
    assert first + int(found[2]) == 5000
    trajectory = read_bag(directory / BAG)
    assert trajectory.completeness.complete
    states = trajectory.states[first:5000]  # (steps, agents, replicas)
    error = ((states - states.mean(axis=1, keepdims=True)) ** 2).sum(axis=1).mean()
    assert found[1] == f"{error:.6g}"


def test_a_run_of_which_no_state_comes_is_over(network: Any, domain: int, twin_bag: Path) -> None:
    """It ended before the watcher had found its agents, for example."""
    live = network.start("live", "--timeout", "60")
    play = network.start("play", twin_bag, "--topics", "/experiment", "--await", "live")
    network.ended(play)
    stdout, _ = network.ended(live, code=3)
    assert "no complete step yet" in stdout


@pytest.mark.parametrize("options", [(), ("--reliable",)])
def test_the_player_does_not_wait_for_a_watcher_that_has_left(
    network: Any, domain: int, twin_bag: Path, options: tuple[str, ...]
) -> None:
    """The watcher ends with the run, long before the middleware asks it what it has got."""
    live = network.start("live", *options)
    _, said = network.ended(network.start("play", twin_bag, "--rate", "max", "--await", "live"))
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
    network.ended(play)
    live.send_signal(signal.SIGCONT)
    stdout, _ = network.ended(live, live.wait(60))
    assert live.returncode in (0, 3)  # it may have missed the last step
    errors = r"system error [\d.]+ ± [\d.]+ \(95 %\), predicted [\d.]+, z = [+-][\d.]+"
    evidence = r"at all times ± [\d.]+, evidence against the prediction [\d.]+ \(threshold 100\)"
    assert re.search(rf"{errors}, {evidence}, \d+ steps", stdout)


def wait_for_steps(live: subprocess.Popen[str]) -> None:
    """Until it has something to say."""
    while " steps" not in (line := live.stdout.readline()):
        assert line, live.communicate()


@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST"])
def test_interrupted_it_says_what_it_has(
    network: Any, domain: int, twin_bag: Path, monkeypatch: pytest.MonkeyPatch, reach: str
) -> None:
    """Exit code 3: not seen to the end. Without any network too. It uses no shared memory, so it leaves none."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", reach)
    live, play = network.start("live"), network.start("play", twin_bag, "--rate", "0.5", "--await", "live")
    alone = network.start("live", "--domain", "231")
    wait_for_steps(live)
    assert "/dev/shm/fastrtps_" not in Path(f"/proc/{live.pid}/maps").read_text()
    live.send_signal(signal.SIGINT)
    network.ended(live, 3)
    play.send_signal(signal.SIGINT)
    network.ended(play, 130)
    assert "waiting for one. Another domain: --domain D" in alone.stderr.readline()
    alone.send_signal(signal.SIGTERM)
    assert "no network was seen" in network.ended(alone, 3)[1]
    said = network.ended(network.start("live", "--timeout", "1"), 2)[1]
    assert re.search(
        f"after 1 s no network in ROS_DOMAIN_ID {domain} and within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}", said
    )


OTHER = 65534  # a user, which here may still read the files of this Python
KEPT = "--inh-caps +dac_read_search --ambient-caps +dac_read_search"
AS_OTHER = f"setpriv --reuid {OTHER} --regid {OTHER} --clear-groups {KEPT}".split()


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("setpriv"), reason="run as root, with setpriv: another user")
def test_a_user_whose_folder_others_have_taken(network: Any, domain: int) -> None:
    """The log files of ROS, which cannot be written at home, are in a folder of that user all the same."""
    shared = network.directory / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / f"msg_agents-{OTHER}").mkdir(0o700)
    live = network.execute("live", "--timeout", "1", machine=AS_OTHER, TMPDIR=str(shared), HOME="/root")
    assert f"after 1 s no network in ROS_DOMAIN_ID {domain}" in network.ended(live, 2)[1]
    (log,) = shared.glob("*/ros/*.log")
    assert log.stat().st_uid == log.parents[1].stat().st_uid == OTHER


PICTURES = """
import json
import rclpy
from visualization_msgs.msg import MarkerArray
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
def plain(value):
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return value if isinstance(value, int | float | str) else None
rclpy.init()
node = rclpy.create_node("listener")
found = []
qos = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(MarkerArray, "markers", found.append, qos)
print("ready", flush=True)
last = f"step {LAST} "
while not found or last not in "".join(marker.text for marker in found[-1].markers):
    rclpy.spin_once(node, timeout_sec=1.0)
print(json.dumps([plain(array) for array in found]))
"""
STEPS, SPEED = 400, 5  # 4 s: long enough to be found by who watches


def test_pictures_of_a_running_network(network: Any, domain: int) -> None:
    """The last picture is that of the last step: its links, by networkx, and its states, by the bag."""
    # In real time, a process that had to wait for the processor may step under an outdated graph, which it logs.
    script = PICTURES.replace("{LAST}", str(STEPS))
    listener = subprocess.Popen([sys.executable, "-P", "-c", script], stdout=subprocess.PIPE, text=True)
    assert listener.stdout.readline() == "ready\n"
    markers = network.start("markers", "--replica", "2", "--frame", "lab")
    assert "waiting for one" in markers.stderr.readline()
    run = {"duration": STEPS * 0.05, "processes": 2, "pace": "realtime", "speed": SPEED}
    result = network.run(network.experiment(run=run), domain=domain)
    pictures = json.loads(listener.communicate(timeout=60)[0])
    network.ended(markers)
    for picture in pictures:
        names = Counter((marker["ns"], marker["id"]) for marker in picture["markers"])
        assert max(names.values()) == 1
        assert {marker["header"]["frame_id"] for marker in picture["markers"]} == {"lab"}
        assert all(marker["pose"]["orientation"]["w"] == 1.0 for marker in picture["markers"])
        assert all(min(marker["scale"].values()) > 0 for marker in picture["markers"])
    spaces = ("agents", "links", "title", "names")
    (agents,), (links,), (title,), names = ([m for m in pictures[-1]["markers"] if m["ns"] == name] for name in spaces)
    trajectory = result.trajectory
    modes = trajectory.agent_modes[-1].tolist()
    assert title["text"] == f"net  step {STEPS}  t = 20  {('line', 'ring')[modes[0]]}"
    places = [(point["x"], point["y"]) for point in agents["points"]]
    assert len(set(places)) == 5
    ends = [places.index((point["x"], point["y"])) for point in links["points"]]
    drawn = sorted(tuple(sorted(pair)) for pair in zip(ends[::2], ends[1::2], strict=True))
    graphs = nx.path_graph(5), nx.cycle_graph(5)
    heard = {tuple(sorted((i, j))) for i, mode in enumerate(modes) for j in graphs[mode].neighbors(i)}
    assert drawn == sorted(heard)
    state = trajectory.values[-1, :, 1]
    deviation = state - state.mean()
    redness = np.array([colour["r"] - colour["b"] for colour in agents["colors"]])
    assert all((redness > 0.0) == (deviation > 0)) or abs(deviation).min() < 1e-3
    assert np.all(np.diff(redness[np.argsort(deviation)]) >= 0)
    assert [marker["text"] for marker in names] == list("12345")


def test_no_such_replica(network: Any, domain: int, twin_bag: Path) -> None:
    """Said once the experiment is known, which a bag that is being played keeps there."""
    play, markers = network.start("play", twin_bag, "--rate", "0.1"), network.start("markers", "--replica", "3")
    assert "--replica: 3: expected a number from 1 to 2" in network.ended(markers, 2)[1]
    play.terminate()
    play.wait(60)
