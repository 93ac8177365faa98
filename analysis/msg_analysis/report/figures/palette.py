"""The Okabe-Ito colours, which colour-blind readers can tell apart; shapes and line styles differ as well."""

from __future__ import annotations

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
MODE_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, YELLOW, BLACK)
LINE_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, "#8a7d00")  # thin lines on white: no yellow
INK, DARK_GREY, GREY, LIGHT_GREY, PALE = "#374151", "#4b5563", "#6b7280", "#9ca3af", "#e5e7eb"


def mode_colour(mode: int) -> str:
    """Colour of a graph, from 0; repeats after eight."""
    return MODE_COLOURS[mode % len(MODE_COLOURS)]


def shorten(name: str, length: int = 18) -> str:
    """The name cut to ``length`` characters, the last of which is then an ellipsis."""
    return name if len(name) <= length else name[: length - 1] + "…"
