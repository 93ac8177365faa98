"""Quality of service of every topic, in one place, as ROS objects.

All are reliable and keep-all: a slow reader holds the writer back end to end (``publish`` raises when nobody takes what
it wrote). Keep-last, of any depth, loses messages silently to a busy reader.

What is rare and needed by whoever comes is latched (transient-local): a reader that comes late still gets it. States
are not: the start gate waits for their readers, and a writer that keeps thousands of old ones works in cold memory,
which costs a network a tenth of its speed.
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
"""Of what replaces what came before: nobody is waited for, and who comes late gets the newest."""
