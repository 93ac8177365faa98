"""Runs in real time: the order of events, the logged-pattern law, lateness and age of what was used.

May import inference.errors and what is below it.
"""
