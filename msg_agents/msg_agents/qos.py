"""Quality of service of every topic, in one place, as ROS objects.

States, graph and experiment are reliable, keep-all and transient-local: a slow reader holds the writer back end to end
(``publish`` raises when nobody takes what it wrote), and a reader that comes a little late still gets everything from
the first message. Keep-last, of any depth, loses messages silently to a busy reader.
"""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

LOSSLESS = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=0,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
