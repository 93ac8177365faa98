"""Intervals of normal estimates."""

HALF_WIDTH_95 = 1.959963984540054
"""Half-width of a 95 % interval, in standard errors."""
