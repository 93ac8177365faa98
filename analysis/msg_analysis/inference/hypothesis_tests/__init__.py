"""Tests of the law of a run: innovations, gains, switching, losses, broadcast noise.

Mean-square errors belong to ``inference.errors``. May import inference.observed and inference.statistics.
"""
