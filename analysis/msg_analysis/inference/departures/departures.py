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

"""All kinds of departures of a run, or of several."""

from __future__ import annotations

from collections.abc import Sequence

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law
from msg_analysis.inference.departures.largest_innovation import LargestInnovation
from msg_analysis.inference.departures.long_lags import LongLags
from msg_analysis.inference.departures.noise_by_graph import NoiseByGraph
from msg_analysis.inference.departures.noise_over_time import NoiseOverTime
from msg_analysis.inference.departures.sojourns import Sojourns
from msg_analysis.inference.departures.stale_values import StaleValues
from msg_analysis.inference.departures.standing_still import StandingStill
from msg_analysis.inference.departures.swapped_graphs import SwappedGraphs
from msg_analysis.types import FloatArray


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
