"""Comparisons of runs with predictions: estimates, standard errors, tests, the verdict.

The folders, lowest first: statistics, observed, hypothesis_tests, errors, realtime, blame, verdict, online. They may
import model, theory and twin.
"""
