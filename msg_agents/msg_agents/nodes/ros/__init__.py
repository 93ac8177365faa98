"""rclpy as the nodes use it: QoS, parameters, timers, a node without unused services.

Nothing about networks. Imports only msg_analysis.
"""
