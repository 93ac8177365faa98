"""How the processes of a network find each other: domains, ports, Fast DDS profiles, introductions. Pure."""
