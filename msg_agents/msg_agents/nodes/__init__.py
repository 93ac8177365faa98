"""The nodes of a network and the life of their process: the only folder that imports rclpy.

Its own folders: ros is below; agents, watching and replay are above. May import stepping, terminal, processes, recovery
and replay.
"""
