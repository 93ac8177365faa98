# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Colours, short names and places of the agents, for all drawings; loads neither matplotlib nor Bokeh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray
from msg_analysis.experiment.graphs import Graph

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
# Dull colours for graphs, saturated ones for agents; vermillion is what is rejected.
MODE_COLOURS = ("#64788c", "#77864a", "#93709c", "#7a5c3e", "#4f8a8b", "#a0705a", "#7f8794", "#4b4f57")
LINE_COLOURS = (BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK, "#8a7d00", "#6a4fb3")  # thin lines on white: no yellow
INK, DARK_GREY, GREY, LIGHT_GREY, PALE = "#374151", "#4b5563", "#6b7280", "#9ca3af", "#e5e7eb"


def column_of(rows: Sequence[Mapping[str, Any]], key: str) -> FloatArray:
    """(rows,): numbers of documents; NaN where one is None or not there."""
    return np.array([row.get(key) for row in rows], dtype=float)


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


def _grid_of(links: BoolArray) -> tuple[int, int] | None:
    """Rows and columns of a grid with these links (m, m), its agents row by row; None if there is none of two rows."""
    m = len(links)
    for rows in range(2, m // 2 + 1):
        if m % rows == 0:
            numbers = np.arange(m).reshape(rows, -1)
            pairs = np.concatenate(
                [
                    np.stack([numbers[:, :-1], numbers[:, 1:]], -1).reshape(-1, 2),
                    np.stack([numbers[:-1], numbers[1:]], -1).reshape(-1, 2),
                ]
            )
            expected = np.zeros_like(links)
            expected[pairs[:, 0], pairs[:, 1]] = expected[pairs[:, 1], pairs[:, 0]] = True
            if np.array_equal(links, expected):
                return rows, m // rows
    return None


def places(graph_list: Sequence[Graph]) -> Mapping[int, FloatArray]:
    """Position (2,) of every agent, from 0, within about -1 to 1; laid out by the union of all graphs."""
    for graph in graph_list:
        if (shape := _grid_of(graph.adjacency > 0)) is not None:
            rows, columns = np.indices(shape)
            scale = max(*shape, 2) - 1
            ends = np.stack([2 * columns - shape[1] + 1, shape[0] - 1 - 2 * rows], axis=-1).reshape(-1, 2) / scale
            return dict(enumerate(ends))
    import networkx as nx

    union = nx.from_numpy_array(sum((g.adjacency + g.adjacency.T > 0) for g in graph_list) > 0)
    if max(degree for _, degree in union.degree) > max(4, len(union) / 2):
        found: Mapping[int, FloatArray] = nx.circular_layout(union)  # for example stars and complete graphs
    elif nx.is_connected(union) and len(union) <= 120:
        found = nx.kamada_kawai_layout(union)
    else:
        found = nx.spring_layout(union, seed=1, iterations=200)
    return found
