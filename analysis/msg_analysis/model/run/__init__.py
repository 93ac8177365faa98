"""One run: its record, its path of graphs, the law of each of its agents, and its outcome.

Running it belongs to ``twin`` and msg_agents. May import model.step and what is below it.
"""
