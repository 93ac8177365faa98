"""The reproduction of the paper's three numerical examples.

May import everything below ``api``; only ``cli`` imports it.
"""
