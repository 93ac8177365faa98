"""What a killed process leaves, and how the next process takes over from it. No ROS.

May import stepping and processes.
"""
