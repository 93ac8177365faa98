# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Start a network as ROS 2 nodes, record it, and compare the record with the theory.

    ros2 launch msg_agents_bringup network.launch.py experiment:=line_ring duration:=50.0

All decisions are made in msg_agents.run.launch; msg_agents.nodes.launch_actions passes them to launch.
"""

from msg_agents.nodes.launch_actions import describe
from msg_agents.run.launch import NETWORK_ARGUMENTS, LaunchedNetwork


def generate_launch_description():
    return describe(NETWORK_ARGUMENTS, LaunchedNetwork)
