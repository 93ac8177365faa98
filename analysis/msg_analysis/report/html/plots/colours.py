# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Colours of the report, for white pages and for dark ones.

Those of lines and graphs are the Okabe-Ito colours, which colour-blind readers can tell apart, darker where their
contrast to white is below 3; shapes and line styles differ as well. The page's script exchanges them in the plots.
"""

from __future__ import annotations

BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#b97a00", "#00875f", "#b4598c"
SKY, VERMILLION, OLIVE, BLACK = "#2a8fcb", "#c85000", "#8a7d00", "#000000"
GRAPHS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, OLIVE, BLACK)
LINES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, OLIVE)
INK, GREY, PALE, PAGE = "#374151", "#6b7280", "#e5e7eb", "#ffffff"
DARK = {
    BLUE: "#4da3e0",
    ORANGE: "#f0b030",
    GREEN: "#2fc79a",
    PURPLE: "#e39ac6",
    SKY: "#9adbff",
    VERMILLION: "#ff8a4c",
    OLIVE: "#f0e442",
    BLACK: "#f9fafb",
    INK: "#d1d5db",
    GREY: "#9ca3af",
    PALE: "#2b3340",
    PAGE: "#12161d",
}
"""The colours on a dark page, by those on a white one; all different."""
HEAT = ("#b35806", "#f1a340", "#f7f7f7", "#998ec3", "#542788")
"""Of matrices, from the lowest to the highest number, with zero in the middle."""
DARK_HEAT = ("#ffb454", "#8a5a1e", "#1b2029", "#5a4c97", "#b9a8ff")

SCALE = ("#f7f7f7", "#c9bdf0", "#8a78d0")
"""Of results, from the lowest to the highest; black numbers are read on all of them, and white ones in the dark."""
DARK_SCALE = ("#1b2029", "#3d3578", "#6450c0")


def graph_colour(mode: int) -> str:
    """Colour of a graph, from 0; repeats after eight."""
    return GRAPHS[mode % len(GRAPHS)]


def graph_variable(mode: int) -> str:
    """The same as a variable of the page's style, which depends on the scheme."""
    return f"var(--graph-{mode % len(GRAPHS)})"
