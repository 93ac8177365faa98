"""The experiment file: its keys, all checks, and the valid experiment.

What a step of it does belongs to ``model.step``. May import model.network, model.arithmetic and ``protocol``.
"""
