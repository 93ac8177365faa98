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

"""The cells of the matrix, and how a user names some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

from msg_analysis.errors import InputError
from msg_analysis.wire.topics import Qos

Reader = Literal["first", "late", "killed", "slow", "stopped"]

MANY = 4  # readers of a topic, each in a process of its own
LATCHED_FACTOR = 10  # times as many tries where a late reader must get old messages: what goes wrong there is rare
DEPTHS = (1, 10, 1000, None)  # None: keep all
AXES: dict[str, tuple[str, ...]] = {
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
    "history": ("keep_last_1", "keep_last_10", "keep_last_1000", "keep_all"),
    "reader": ("first", "late", "killed", "slow", "stopped"),
    "readers": ("one", "many"),
}


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: both sides have this quality of service."""

    qos: Qos
    reader: Reader
    readers: int  # of each topic

    @property
    def words(self) -> tuple[str, ...]:
        """One word of each axis, in the order of ``AXES``."""
        return (
            "reliable" if self.qos.reliable else "best_effort",
            "transient_local" if self.qos.latched else "volatile",
            "keep_all" if self.qos.depth is None else f"keep_last_{self.qos.depth}",
            self.reader,
            "one" if self.readers == 1 else "many",
        )

    def tries(self, usual: int) -> int:
        """How often it is tried, if a usual cell is tried so often."""
        late_latched = self.reader == "late" and self.qos.latched and self.qos.reliable
        return usual * LATCHED_FACTOR if late_latched else usual


def all_cells() -> list[Cell]:
    """Every combination, those of one quality of service together."""
    readers: tuple[Reader, ...] = ("first", "late", "killed", "slow", "stopped")
    return [
        Cell(Qos(depth, reliable=reliable, latched=latched), reader, count)
        for reliable, latched, depth, reader, count in product((True, False), (False, True), DEPTHS, readers, (1, MANY))
    ]


def select_cells(only: str | None) -> Sequence[Cell]:
    """The cells with the words of a user: of several words of one axis each is wanted. InputError: unknown word."""
    words = {word.strip() for word in only.split(",")} if only is not None else set()
    known = [word for axis in AXES.values() for word in axis]
    if unknown := sorted(words - {*known}):
        listed = ", ".join(known)
        raise InputError(
            f"--only: {unknown[0]!r}: expected words with commas between them: correct it to some of {listed}"
        )
    wanted = [words & {*axis} or {*axis} for axis in AXES.values()]
    return [cell for cell in all_cells() if all(word in axis for word, axis in zip(cell.words, wanted, strict=True))]
