"""Bags of the network: CDR bytes, MCAP files, and the trajectories in them.

No ROS; of this package only ``model`` and the modules beside it (``errors``, ``types``) are imported.
"""
