"""Predictions: second moments of jump linear systems."""
