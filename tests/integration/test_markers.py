"""Pictures of a network, as whoever draws them gets them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from typing import Any

import networkx as nx
import numpy as np
import pytest

from msg_agents.discovery.rtps import free_domain
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.twin.simulate import simulate

LISTENER = """
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


def by_space(array: dict[str, Any], namespace: str) -> list[dict[str, Any]]:
    return [marker for marker in array["markers"] if marker["ns"] == namespace]


def test_pictures_of_a_running_network(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last picture is that of the last step: its links, by networkx, and its states, by the bag.

    In real time, a process that had to wait for the processor may step under an outdated graph, which it logs.
    """
    with free_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        script = LISTENER.replace("{LAST}", str(STEPS))
        listener = subprocess.Popen([sys.executable, "-P", "-c", script], stdout=subprocess.PIPE, text=True)
        assert listener.stdout
        assert listener.stdout.readline() == "ready\n"
        markers = network.start("markers", "--replica", "2", "--frame", "lab")
        assert "waiting for one" in markers.stderr.readline()
        run = {"duration": STEPS * 0.05, "processes": 2, "pace": "realtime", "speed": SPEED}
        result = network.run(network.experiment(run=run), domain=domain)
        assert result.failures == []
        pictures = json.loads(listener.communicate(timeout=60)[0])
        stderr = markers.communicate(timeout=60)[1]
        assert (markers.returncode, "Traceback" in stderr) == (0, False), stderr
    for picture in pictures:
        names = Counter((marker["ns"], marker["id"]) for marker in picture["markers"])
        assert max(names.values()) == 1
        assert {marker["header"]["frame_id"] for marker in picture["markers"]} == {"lab"}
        assert all(marker["pose"]["orientation"]["w"] == 1.0 for marker in picture["markers"])
        assert all(min(marker["scale"].values()) > 0 for marker in picture["markers"])
    (agents,), (links,), (title,) = (by_space(pictures[-1], name) for name in ("agents", "links", "title"))
    trajectory = result.trajectory
    assert trajectory.agent_modes is not None
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
    assert [marker["text"] for marker in by_space(pictures[-1], "names")] == list("12345")


def test_no_such_replica(network: Any) -> None:
    """Said once the experiment is known, which a bag that is being played keeps there."""
    bag = network.directory / "bag"
    write_trajectory(simulate(network.experiment()), bag)
    with free_domain() as domain:
        play = network.start("play", bag, "--rate", "0.1", "--domain", str(domain))
        markers = network.start("markers", "--replica", "3", "--domain", str(domain))
        stderr = markers.communicate(timeout=60)[1]
        play.terminate()
        play.communicate(timeout=60)
    assert markers.returncode == 2
    assert "--replica: 3: expected a number from 1 to 2" in stderr
    assert "Traceback" not in stderr
