"""The agents as nodes: in lockstep, in real time, and several in one process.

May import nodes and what is below it.
"""
