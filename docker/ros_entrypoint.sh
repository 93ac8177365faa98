#!/bin/bash
# Makes ROS 2 and this software known, then runs what it is told to.
set -e
source /opt/ros/jazzy/setup.bash
source /opt/msg_agents/setup.bash
PYTHONPATH="$(echo /opt/python/lib/python3*/site-packages):$PYTHONPATH"
PATH="/opt/msg_agents/lib/msg_agents:/opt/msg_agents/lib/msg_analysis:$PATH"
export PYTHONPATH PATH
exec "$@"
