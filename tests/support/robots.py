"""A bag of five robots that no part of the software made: scipy's exponentials, written by rosbags."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks/foreign_logs.py"))
START = 1_760_000_000_000_000_000  # ns
LAW = """\
name: robots
graphs:
  line: {path: [1, 2, 3, 4, 5]}
  ring: {cycle: [1, 2, 3, 4, 5]}
switching: {generator: [[-0.5, 0.5], [0.5, -0.5]]}
noise: {process: [1.0, 0.8, 1.2, 1.0, 0.9]}
"""


def write_robots(bag: Path, samples: int = 2000, seed: int = 1, **faults: Any) -> Path:
    """Odometry on /robot_1/odom, ..., ten times a second, and names of graphs on /network/active."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types, odometry, text = store.types, "nav_msgs/msg/Odometry", "std_msgs/msg/String"
    times, states, starts, names = SCRIPT["simulate"](SCRIPT["Kind"](**faults), samples, np.random.default_rng(seed))
    none = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](none, none), np.zeros(36))

    def message(time: int, x: float) -> bytes:
        stamp = types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
        pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, 0.0, 0.0), turn)
        whole = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
        made = types[odometry](types["std_msgs/msg/Header"](stamp, "odom"), "base_link", whole, twist)
        return bytes(store.serialize_cdr(made, odometry))

    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        robots = [writer.add_connection(f"/robot_{i}/odom", odometry, typestore=store) for i in range(1, 6)]
        network = writer.add_connection("/network/active", text, typestore=store)
        events = [(round(1e9 * t), -1, name) for t, name in zip(starts, names, strict=True)]
        events += [(round(1e9 * t), i, float(states[k, i])) for k, t in enumerate(times) for i in range(5)]
        for time, robot, value in sorted(events, key=lambda event: event[:2]):
            if robot < 0:
                writer.write(network, START + time, bytes(store.serialize_cdr(types[text](value), text)))
            else:
                writer.write(robots[robot], START + time, message(START + time, value))
    return bag
