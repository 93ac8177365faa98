"""Bags of the network: reading, writing, salvage, and the trajectories in them. No ROS.

Message bytes belong to ``wire``, the format of the files to ``bags.format``. May import both, and model.
"""
