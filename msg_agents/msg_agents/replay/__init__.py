"""What a player decides: the time of the bag, the topics. No ROS: the player itself is in ``nodes.replay``.

Imports only msg_analysis.
"""
