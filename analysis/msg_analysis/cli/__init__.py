"""The command line ``msg-analysis``: each command parses, calls one function, prints.

May import everything; nothing imports it except ``__main__`` and the command line of msg_agents.
"""
