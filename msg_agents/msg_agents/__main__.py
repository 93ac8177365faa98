"""``python -m msg_agents`` is ``msg-agents``."""

from msg_agents.cli import main

if __name__ == "__main__":
    main()
