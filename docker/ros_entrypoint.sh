#!/bin/bash
# Set the paths of ROS 2 and of this software, then run the given command.
set -e
source /opt/ros/jazzy/setup.bash
source /opt/msg_agents/setup.bash
PYTHONPATH="$(echo /opt/python/lib/python3*/site-packages):$PYTHONPATH"
PATH="/opt/msg_agents/lib/msg_agents:/opt/msg_agents/lib/msg_analysis:$PATH"
export PYTHONPATH PATH
exec "$@"
