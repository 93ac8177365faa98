"""Nodes without what ROS 2 gives every node and nobody needs here."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from msg_agents.errors import RCLError


class QuietNode(Node):  # type: ignore[misc]  # rclpy has no type hints that mypy can follow
    """A node without parameter services, type descriptions and /rosout.

    Each node would bring eight services and /rosout: with many nodes they cost more than the network.

    Parameters
    ----------
    name : of the node
    """

    def __init__(self, name: str) -> None:
        super().__init__(
            name,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )

    def publish(self, publisher: Publisher, data: bytes) -> None:
        """Publish bytes until they go through.

        A reader that does not keep up blocks a reliable keep-all writer; after 100 ms the middleware gives up and
        raises, and the message has not been written.
        """
        while True:
            try:
                # What Publisher.publish comes down to for bytes, without taking hold of the handle each time.
                publisher.handle.publish_raw(data)
                return
            except RCLError:
                if not self.context.ok():
                    raise
