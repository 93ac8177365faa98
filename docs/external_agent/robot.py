"""A robot that knows nothing of msg_agents: python robot.py NUMBER NEIGHBOUR... (plain rclpy and std_msgs)."""

import contextlib
import math
import random
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float64

PERIOD, FRESH = 0.005, 0.15  # s


class Robot(Node):
    """Moves towards what it hears, with noise, two hundred times a second."""

    def __init__(self, number, neighbours, gain=1.0):
        super().__init__(f"robot_{number}")
        self.x, self.gain, self.heard, self.last = 0.0, gain, {}, time.monotonic()
        self.random = random.Random(number)
        self.publisher = self.create_publisher(Float64, f"robot_{number}/x", qos_profile_sensor_data)
        for j in neighbours:
            topic = f"agent_{number}/heard/agent_{j}"
            self.create_subscription(Float64, topic, lambda m, j=j: self.hear(j, m), qos_profile_sensor_data)
        self.create_timer(PERIOD, self.move)

    def hear(self, j, message):
        """Keep the newest value of a neighbour: one that is not heard any more is not linked."""
        self.heard[j] = message.data, time.monotonic()

    def move(self):
        """Go on by the time that has passed; before anything is heard, the run has not begun."""
        now = time.monotonic()
        dt, self.last = (now - self.last if self.heard else 0.0), now
        pull = sum(value - self.x for value, at in self.heard.values() if now - at < FRESH)
        self.x += self.gain * pull * dt + math.sqrt(dt) * self.random.gauss(0.0, 1.0)
        self.publisher.publish(Float64(data=self.x))


if __name__ == "__main__":
    rclpy.init()
    gain = float(sys.argv.pop()) if "." in sys.argv[-1] else 1.0
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Robot(int(sys.argv[1]), map(int, sys.argv[2:]), gain))
