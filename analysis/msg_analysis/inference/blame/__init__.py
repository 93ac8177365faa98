"""Why a run disagrees: single causes and their estimates.

May import inference.hypothesis_tests, inference.observed and inference.statistics.
"""
