"""Sweeps: one experiment at many values of its keys, on the processors of this machine or of a cluster.

No ROS: networks run as processes of their own.
"""
