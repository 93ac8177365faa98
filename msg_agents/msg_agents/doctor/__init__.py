"""What this machine and shell would do to a run. No ROS.

May import all folders without ROS. Where a run makes the same check, both call one function.
"""
