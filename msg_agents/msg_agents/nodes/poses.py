# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""States as positions, for programs that know nothing of this software: x is the state."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Point, PointStamped, PoseStamped
from rclpy.node import Node
from std_msgs.msg import Float64, Header

from msg_analysis.model.run_record import RunRecord

FRAME = "map"
KINDS: dict[str, type[Any]] = {"number": Float64, "point": PointStamped, "pose": PoseStamped}  # by ``hears`` of a map


class StateMessages:
    """Makes messages of one kind from states."""

    def __init__(self, node: Node, record: RunRecord, kind: str) -> None:
        self.type, self._kind = KINDS[kind], kind
        self._clock, self._frame = node.get_clock(), record.experiment.run.frame or FRAME

    def message(self, x: float) -> Any:
        """The message, stamped with the time of the node's clock; the orientation of a pose is the identity."""
        if self._kind == "number":
            return Float64(data=x)
        header = Header(stamp=self._clock.now().to_msg(), frame_id=self._frame)
        if self._kind == "point":
            return PointStamped(header=header, point=Point(x=x))
        pose = PoseStamped(header=header)
        pose.pose.position.x = x
        return pose
