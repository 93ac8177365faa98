"""Predictions of second moments: steady states, transients, settling, indices.

Nothing measured belongs here. May import model; of its own folders, system and solvers are below, leaders above.
"""
