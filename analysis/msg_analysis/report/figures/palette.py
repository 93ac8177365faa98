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
