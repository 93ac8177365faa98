"""Comparisons of runs with predictions: estimates, standard errors, tests, the verdict."""
