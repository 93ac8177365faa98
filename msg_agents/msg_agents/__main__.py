"""``python -m msg_agents`` is ``msg-agents``."""

from msg_agents.executables import msg_agents

if __name__ == "__main__":
    msg_agents()
