"""Three protocols for msg_agents, as examples of how to write one."""
