"""A whole run: starting, watching and ending its processes, bag, verdict, report. No ROS.

May import all folders without ROS.
"""
