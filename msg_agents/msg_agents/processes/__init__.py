"""The processes of a network: which, on which host and core, in which ROS domain and environment. No ROS.

Starting them belongs to ``running``. Imports only msg_analysis.
"""
