"""Measured mean-square errors beside the predicted ones: time means, estimates, control variate, ranking.

May import inference.hypothesis_tests, inference.observed and inference.statistics.
"""
