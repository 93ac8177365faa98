"""What figures have in common (colours, places of the agents, matplotlib style), and the figure of a sweep.

May import sweep and what is below it.
"""
