# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Colours, short names and places of the agents, for all drawings; loads neither matplotlib nor Bokeh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.graphs import Graph

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
MODE_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, YELLOW, BLACK)
LINE_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, "#8a7d00")  # thin lines on white: no yellow
INK, DARK_GREY, GREY, LIGHT_GREY, PALE = "#374151", "#4b5563", "#6b7280", "#9ca3af", "#e5e7eb"


LABELLED = 40  # most agents whose numbers are shown


def shorten(name: str, length: int = 18) -> str:
    """The name cut to ``length`` characters, the last of which is then an ellipsis."""
    return name if len(name) <= length else name[: length - 1] + "…"


_FREE = 0.4  # of the way to the next value: left free between the points of two values
_MOST = 0.02  # of the axis, between two series


def shifted(places: FloatArray, values: FloatArray, series: int, count: int, *, logarithmic: bool) -> FloatArray:
    """Places along the axis of the points of a series, of ``count``, from 0; ``values``: those of all series."""
    if count < 2:
        return places
    known = np.unique(np.log(values) if logarithmic else values)
    gaps = np.diff(known)
    length = float(known[-1] - known[0]) if len(known) > 1 else 1.0
    nearest = float(gaps.min()) if len(gaps) else length
    step = min((1 - _FREE) * nearest / count, _MOST * length)
    way = (series - (count - 1) / 2) * step
    return places * np.exp(way) if logarithmic else places + way


def places(graph_list: Sequence[Graph]) -> Mapping[int, FloatArray]:
    """Position (2,) of every agent, from 0, within about -1 to 1; laid out by the union of all graphs."""
    import networkx as nx

    union = nx.from_numpy_array(sum((g.adjacency + g.adjacency.T > 0) for g in graph_list) > 0)
    if max(degree for _, degree in union.degree) > max(4, len(union) / 2):
        found: Mapping[int, FloatArray] = nx.circular_layout(union)  # for example stars and complete graphs
    elif nx.is_connected(union) and len(union) <= 120:
        found = nx.kamada_kawai_layout(union)
    else:
        found = nx.spring_layout(union, seed=1, iterations=200)
    return found
