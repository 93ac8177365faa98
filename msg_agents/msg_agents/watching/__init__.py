"""What people see of a run while it goes on: panel, page for browsers, and what they show. No ROS.

May import terminal, processes and recovery.
"""
