"""Numerical solutions of the equations of second moments: steady and over time, dense and matrix-free.

What the solutions mean belongs to ``theory``. May import theory.system and model.
"""
