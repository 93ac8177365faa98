"""``python -m msg_agents`` is ``msg-agents``."""

from msg_agents.cli.entry_points import msg_agents

if __name__ == "__main__":
    msg_agents()
