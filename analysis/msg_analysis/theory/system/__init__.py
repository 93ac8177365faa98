"""The reduced Markov jump linear system of an experiment, and the form of its second moments.

Solving for them belongs to ``theory.solvers``. May import model.
"""
