"""Quality of service of the topics of a run, as ROS objects.

STREAM and LATCHED are reliable and keep-all: a slow reader holds the writer back end to end (``publish`` raises when no
reader takes what it wrote). Keep-last, of any depth, loses messages silently to a busy reader.

Rare messages that late readers need are latched (transient-local). States are not: the start gate waits for their
readers, and a writer that keeps thousands of old ones works in cold memory, which costs a network a tenth of its speed.
"""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=0,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=0,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For values that replace earlier ones: the writer never waits, and a late reader gets the newest."""
