# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""All kinds of departures of a run, or of several."""

from __future__ import annotations

from collections.abc import Sequence

from msg_analysis.common.arrays import FloatArray
from msg_analysis.inference.dependence import LongLags, StandingStill
from msg_analysis.inference.diagnostics import Block, Departure, Finding, Law
from msg_analysis.inference.messages import StaleValues
from msg_analysis.inference.noise_diagnostics import NoiseByGraph, NoiseOverTime
from msg_analysis.inference.residuals import LargestInnovation
from msg_analysis.inference.switching import Sojourns, SwappedGraphs


class Departures:
    """Sums for every kind that a law can have."""

    def __init__(self, law: Law) -> None:
        self.kinds: list[Departure] = [
            Sojourns(law),
            NoiseByGraph(law),
            NoiseOverTime(law),
            StandingStill(law),
            LargestInnovation(law),
            LongLags(law),
            StaleValues(law),
            SwappedGraphs(law),
        ]

    def add(self, block: Block) -> dict[str, FloatArray]:
        """Add steps, which follow those that were added before: (T, ...) of ``families`` after each look."""
        each = {kind.test: kind.add(block) for kind in self.kinds}
        return {test: logarithms for test, logarithms in each.items() if logarithms.size}

    def merge(self, other: Departures) -> None:
        """Add the sums of other runs of the same experiment, with other seeds."""
        for mine, its in zip(self.kinds, other.kinds, strict=True):
            mine.merge(its)

    def findings(self) -> list[Finding]:
        """The clearest departure of each kind that can be tested."""
        return [finding for kind in self.kinds if (finding := kind.finding())]

    def families(self) -> dict[str, FloatArray]:
        """For each kind the evidence on its questions, logarithms (questions, alternatives)."""
        each = {kind.test: kind.evidence() for kind in self.kinds}
        return {test: logarithms for test, logarithms in each.items() if logarithms.size}

    def question(self, test: str, row: int, graphs: Sequence[str]) -> str | None:
        """What a row of ``families`` is about, with graphs by name; None where the kind is none of these."""
        found = next((kind for kind in self.kinds if kind.test == test), None)
        if found is None:
            return None
        words, named = found.questions()[row]
        return words.format(*(graphs[graph] for graph in named))
