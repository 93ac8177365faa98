"""Publish a recorded network again, and watch it.

ros2 launch msg_agents_bringup replay.launch.py bag:=runs/line_ring_20260114_083441 rate:=max
"""

from msg_agents.nodes.launch_actions import describe
from msg_agents.running.launch_arguments import REPLAY_ARGUMENTS
from msg_agents.running.launch_support import LaunchedReplay


def generate_launch_description():
    return describe(REPLAY_ARGUMENTS, LaunchedReplay)
