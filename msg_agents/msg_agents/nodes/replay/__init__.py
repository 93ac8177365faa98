"""The player: publishes the messages of a bag again.

May import nodes and what is below it.
"""
