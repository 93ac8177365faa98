# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Start a network as ROS 2 nodes, record it, and compare the record with the theory.

    ros2 launch msg_agents_bringup network.launch.py experiment:=line_ring duration:=50.0

All decisions are made in msg_agents.running.launch_support; msg_agents.nodes.launch_actions passes them to launch.
"""

from msg_agents.nodes.launch_actions import describe
from msg_agents.running.launch_arguments import NETWORK_ARGUMENTS
from msg_agents.running.launch_support import LaunchedNetwork


def generate_launch_description():
    return describe(NETWORK_ARGUMENTS, LaunchedNetwork)
