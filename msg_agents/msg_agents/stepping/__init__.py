"""When an agent makes a step, and with which values: pure logic, tested without processes.

No ROS, no files. Imports only msg_analysis.
"""
