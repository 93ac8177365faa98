"""A subscriber that knows nothing of us and writes what comes into an MCAP file.

It ends when so many messages have come, some on every topic.

python plain_recorder.py FILE COUNT TOPIC...
"""

import sys
from collections.abc import Callable
from pathlib import Path

import rclpy
from mcap.writer import CompressionType, Writer
from msg_agents_interfaces.msg import ActiveGraph, AgentState
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

KINDS = {"experiment": String, "graph": ActiveGraph, "state": AgentState, "truth": AgentState, "clock": Clock}


def main(file: str, count: int, topics: list[str]) -> None:
    """Record, and say so at the end."""
    rclpy.init()
    node = rclpy.create_node("plain")
    left, silent = count, set(topics)
    with Path(file).open("wb") as stream:
        writer = Writer(stream, chunk_size=4096, compression=CompressionType.NONE)  # the file grows as messages come
        writer.start()
        schema = writer.register_schema("any", "", b"")

        def taker(channel: int, topic: str) -> Callable[[bytes], None]:
            def take(data: bytes) -> None:
                nonlocal left
                left -= 1
                silent.discard(topic)
                now = node.get_clock().now().nanoseconds
                writer.add_message(channel, now, bytes(data), now)

            return take

        for topic in topics:
            kind = KINDS[topic.split("/")[-1]]
            latched = kind in (String, ActiveGraph)
            qos = QoSProfile(
                history=QoSHistoryPolicy.KEEP_ALL,
                reliability=QoSReliabilityPolicy.RELIABLE,
                durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
            )
            channel = writer.register_channel(topic, "cdr", schema)
            node.create_subscription(kind, topic, taker(channel, topic), qos, raw=True)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while left > 0 or silent:
            executor.spin_once()
        writer.finish()
    print("finished")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
