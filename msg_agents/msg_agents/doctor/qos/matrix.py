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

"""The matrix: all its cells, tried with the middleware of this shell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from msg_agents.doctor.qos.cells import MANY, Cell, Reader
from msg_agents.doctor.qos.tally import CellResult, Try
from msg_agents.doctor.qos.tries import make_tries
from msg_agents.doctor.qos.workers import Workers
from msg_agents.processes.middleware_check import require_middleware
from msg_agents.running.run_folder import workshop
from msg_agents.running.surroundings import surroundings
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.common.long_work import tell
from msg_analysis.common.version import ros_distribution
from msg_analysis.errors import InputError

# Tries side by side: new processes for few late readers; little to be sent while a reader is stopped, so that this is
# soon over.
TOGETHER: dict[Reader, int] = {"first": 20, "late": 10, "killed": 20, "slow": 20, "stopped": 5}
PARTICIPANTS = 1 + 2 * MANY  # at a time: killed readers, too


@dataclass(frozen=True, slots=True)
class Matrix:
    """The result."""

    middleware: str
    distribution: str  # of ROS 2
    cells: Sequence[CellResult]

    @property
    def violating(self) -> list[CellResult]:
        """Cells that contradict ROS 2."""
        return [cell for cell in self.cells if cell.violating]

    @property
    def not_counted(self) -> int:
        """Tries whose processes did not find each other, or were stopped for too long."""
        return sum(not each.counts for cell in self.cells for each in cell.tries)

    @property
    def exit_code(self) -> ExitCode:
        """What the command ends with."""
        if self.violating:
            return ExitCode.DISAGREES
        return ExitCode.INCOMPLETE if self.not_counted else ExitCode.FINE

    def to_json(self) -> dict[str, Any]:
        """As docs/qos.md describes it."""
        return {
            "middleware": self.middleware,
            "ros_distribution": self.distribution,
            "meets": not self.violating,
            "violating": len(self.violating),
            "not_counted": self.not_counted,
            "cells": [cell.to_json() for cell in self.cells],
        }


def measure_matrix(cells: Sequence[Cell], tries: int) -> Matrix:
    """Try every cell so often (see ``Cell.tries``), in a ROS domain of its own.

    InputError: there is no middleware, no domain is free, or a process could not be started or has ended.
    """
    try:
        return _measure(cells, tries)
    except OSError as error:  # too few files or processes
        if error.filename is not None:
            raise
        raise InputError(f"--qos: processes could not be started: {error}: raise that limit") from error


def _measure(cells: Sequence[Cell], tries: int) -> Matrix:
    with (
        workshop() as folder,
        surroundings(folder, None, {}, PARTICIPANTS) as around,
        Workers(around, folder) as workers,
    ):
        require_middleware(around.environment)
        (worker,) = workers.start("writer")
        middleware = worker.ask("identify")["middleware"]
        worker.leave()
        return Matrix(middleware, ros_distribution(), _measure_cells(workers, cells, tries))


def _measure_cells(workers: Workers, cells: Sequence[Cell], usual: int) -> list[CellResult]:
    results: list[CellResult] = []
    total, done = sum(cell.tries(usual) for cell in cells), 0
    for cell in cells:
        made: list[Try] = []
        wanted = cell.tries(usual)
        while len(made) < wanted:
            tell(" ".join(cell.words), done + len(made), total)
            count = min(TOGETHER[cell.reader], wanted - len(made))
            first = done + len(made)
            made += make_tries(workers, cell, [f"qos_{i}" for i in range(first, first + count)])
        done += wanted
        results.append(CellResult(cell, made))
    return results
