"""A robot without ROS, in plain DDS: python dds_robot.py NUMBER NEIGHBOUR... (the package cyclonedds)."""

import math
import os
import random
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

PERIOD, FRESH = 0.005, 0.15  # s


@dataclass
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    """std_msgs/msg/Float64; the topic /name of ROS is the topic rt/name of DDS."""

    data: float64


if __name__ == "__main__":
    number, neighbours = int(sys.argv[1]), sys.argv[2:]
    gain = float(neighbours.pop()) if "." in neighbours[-1] else 1.0
    dds = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0")))
    newest = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    writer = DataWriter(dds, Topic(dds, f"rt/robot_{number}/x", Float64), newest)
    readers = [DataReader(dds, Topic(dds, f"rt/agent_{number}/heard/agent_{j}", Float64), newest) for j in neighbours]
    numbers, x, heard, last = random.Random(number), 0.0, {}, time.monotonic()
    while True:
        now = time.monotonic()
        for reader in readers:
            for message in reader.take():
                if isinstance(message, Float64):  # not the news that a writer has left
                    heard[reader] = message.data, now
        dt, last = (now - last if heard else 0.0), now
        pull = sum(value - x for value, at in heard.values() if now - at < FRESH)
        x += gain * pull * dt + math.sqrt(dt) * numbers.gauss(0.0, 1.0)
        writer.write(Float64(x))
        time.sleep(PERIOD)
