"""What agents, twin and checks compute alike to the last bit: update law, state bytes, random streams, step times.

Nothing here knows an experiment. Imports only the package's ``types`` and ``common``.
"""
