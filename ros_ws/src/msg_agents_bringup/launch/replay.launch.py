# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Publish a recorded network again, and watch it.

ros2 launch msg_agents_bringup replay.launch.py bag:=runs/line_ring_20260114_083441 rate:=max
"""

from msg_agents.nodes.launch_actions import describe
from msg_agents.run.launch import REPLAY_ARGUMENTS, LaunchedReplay


def generate_launch_description():
    return describe(REPLAY_ARGUMENTS, LaunchedReplay)
