"""Experiments, bags and theory explained, as documents for JSON.

May import everything below report.
"""
