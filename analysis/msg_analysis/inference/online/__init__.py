"""Errors of a network while it runs, one step at a time.

May import inference.errors and inference.observed.
"""
