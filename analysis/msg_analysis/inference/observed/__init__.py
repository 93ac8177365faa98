"""What a run shows: its complete beginning, what was measured, and the values that the agents heard.

Tests belong to the folders above. May import model and theory.
"""
