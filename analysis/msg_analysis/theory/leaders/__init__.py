"""The value of sets of leaders, and the search for the best set.

May import theory, its other folders and model.
"""
