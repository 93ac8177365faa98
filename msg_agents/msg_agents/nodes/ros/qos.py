"""Quality of service as ROS objects; the profiles of all topics are in ``msg_analysis.wire.topics``."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from msg_analysis.wire.topics import Qos


def ros_profile(qos: Qos) -> QoSProfile:
    """The profile for rclpy."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if qos.depth is None else HistoryPolicy.KEEP_LAST,
        depth=qos.depth or 0,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    )
