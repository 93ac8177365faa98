"""A robot that publishes poses and hears poses: python pose_robot.py FILE GAIN NUMBER NEIGHBOUR...

At its end it writes to FILE what it heard on the topic of an agent, not meant for it only: frame and x of agent_1/pose.
"""

import contextlib
import json
import math
import random
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

PERIOD, FRESH = 0.005, 0.15  # s


class PoseRobot(Node):  # type: ignore[misc]  # rclpy has no type hints
    def __init__(self, number: int, neighbours: list[int], gain: float) -> None:
        super().__init__(f"robot_{number}")
        self.x, self.gain, self.last = 0.0, gain, time.monotonic()
        self.heard: dict[int, tuple[float, float]] = {}
        self.poses: list[tuple[str, float]] = []
        self.random = random.Random(number)
        self.publisher = self.create_publisher(PoseStamped, f"robot_{number}/pose", qos_profile_sensor_data)
        for j in neighbours:
            topic = f"agent_{number}/heard/agent_{j}"
            self.create_subscription(PoseStamped, topic, lambda m, j=j: self.hear(j, m), qos_profile_sensor_data)
        self.create_subscription(PoseStamped, "agent_1/pose", self.note, 10)
        self.create_timer(PERIOD, self.move)

    def hear(self, j: int, message: Any) -> None:
        self.heard[j] = message.pose.position.x, time.monotonic()

    def note(self, message: Any) -> None:
        self.poses.append((message.header.frame_id, message.pose.position.x))

    def move(self) -> None:
        now = time.monotonic()
        dt, self.last = (now - self.last if self.heard else 0.0), now
        pull = sum(value - self.x for value, at in self.heard.values() if now - at < FRESH)
        self.x += min(self.gain * dt, 0.5) * pull + math.sqrt(dt) * self.random.gauss(0.0, 1.0)
        message = PoseStamped()
        message.pose.position.x = self.x
        self.publisher.publish(message)


if __name__ == "__main__":
    rclpy.init()
    file, gain, number, *others = sys.argv[1:]
    robot = PoseRobot(int(number), [int(j) for j in others], float(gain))
    try:
        with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(robot)
    finally:  # rclpy may raise when a signal comes in the middle of a call
        Path(file).write_text(json.dumps(robot.poses))
