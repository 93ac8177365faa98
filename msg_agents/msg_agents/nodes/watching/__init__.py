"""Nodes that watch a running or replayed network: errors, markers.

May import nodes and what is below it.
"""
