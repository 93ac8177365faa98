"""The command line ``msg-agents``: each command parses, calls one function, prints.

May import everything; rclpy is loaded by the commands that need it.
"""
