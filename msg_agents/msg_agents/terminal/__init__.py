"""Signals, job control and single keys of a terminal. No ROS, nothing about networks."""
