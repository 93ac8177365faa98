"""Measured mean-square errors next to the predicted ones: time means, estimates, control variate, ranking.

May import inference.hypothesis_tests, inference.observed and inference.statistics.
"""
