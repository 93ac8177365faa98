"""Bags of the network: CDR bytes, MCAP files, and the trajectories in them. No ROS."""
