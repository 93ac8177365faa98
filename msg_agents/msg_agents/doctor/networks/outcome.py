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

"""What one network has shown."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from msg_agents.doctor.networks.fault_plan import Fault, FaultPlan
from msg_agents.running.run_result import RunResult
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.common.text.number_words import counted
from msg_analysis.twin.check import check

Status = Literal["equal", "ended", "differs", "failed"]
GOOD = ("equal", "ended")
STATUSES: dict[Status, str] = {
    "equal": "equal to the twin to the last bit",
    "ended": "ended by faults as documented, and equal until then",
    "differs": "different from the twin",
    "failed": "failed",
}
CONSEQUENCES = re.compile(r"\S+: killed by SIGKILL|the bag was salvaged: |nothing was recorded: |last recorded step: ")


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a run went as it had to: equal and complete, or ended by its faults with an equal part."""

    status: Status
    text: str
    compared: int = 0  # states


@dataclass(frozen=True, slots=True)
class Outcome:
    """One network, its faults and its verdict."""

    seed: int
    agents: int
    processes: int  # recorder and switcher included
    graphs: int
    steps: int
    faults: Sequence[Fault]  # those that met a running process
    restarts: Sequence[str]  # one line each
    stalls: Sequence[str]  # what was waited for, one line each
    verdict: Verdict
    wall_time: float  # s, all included
    folder: Path | None = None  # where it is kept

    @property
    def good(self) -> bool:
        """Whether nothing is wrong."""
        return self.verdict.status in GOOD

    @property
    def kills(self) -> int:
        """Processes that were killed."""
        return sum(fault.kills for fault in self.faults)

    @property
    def stops(self) -> int:
        """Processes that were stopped for a while."""
        return len(self.faults) - self.kills

    def to_json(self) -> dict[str, Any]:
        """As docs/commands.md describes it."""
        return {
            "seed": self.seed,
            "status": self.verdict.status,
            "text": self.verdict.text,
            "compared": self.verdict.compared,
            "agents": self.agents,
            "processes": self.processes,
            "graphs": self.graphs,
            "steps": self.steps,
            "faults": [fault.to_json() for fault in self.faults],
            "restarts": list(self.restarts),
            "stalls": list(self.stalls),
            "wall_time": self.wall_time,
            "folder": None if self.folder is None else str(self.folder),
        }


def exit_code(outcomes: Sequence[Outcome]) -> ExitCode:
    """As of ``msg-agents check``: a difference counts more than missing states."""
    if any(outcome.verdict.status == "differs" for outcome in outcomes):
        return ExitCode.DISAGREES
    return ExitCode.FINE if all(outcome.good for outcome in outcomes) else ExitCode.INCOMPLETE


def to_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """As docs/commands.md describes it."""
    counts = Counter(outcome.verdict.status for outcome in outcomes)
    return {
        "good": all(outcome.good for outcome in outcomes),
        **{status: counts[status] for status in STATUSES},
        "networks": [outcome.to_json() for outcome in outcomes],
    }


def summary(outcomes: Sequence[Outcome]) -> str:
    """All networks in one sentence."""
    counts = Counter(outcome.verdict.status for outcome in outcomes)
    found = "; ".join(f"{counts[status]} {words}" for status, words in STATUSES.items() if counts[status])
    done = {
        "network": len(outcomes),
        "kill": sum(outcome.kills for outcome in outcomes),
        "stop": sum(outcome.stops for outcome in outcomes),
        "state": sum(outcome.verdict.compared for outcome in outcomes),
    }
    return f"{', '.join(counted(number, thing) for thing, number in done.items())} compared: {found}."


def judge(result: RunResult, plan: FaultPlan, standstill: str | None = None) -> Verdict:
    """Compare a run with its twin, and its end with what the faults allow that it has met.

    ``standstill``: why it made no step any more, if it was ended for that.
    """
    trajectory = result.trajectory
    compared = missing = twice = 0
    if trajectory is not None:
        outcome = check(trajectory)
        compared, missing, twice = outcome.compared, outcome.missing, trajectory.completeness.duplicates
        if outcome.difference:
            return Verdict("differs", outcome.difference, compared)
    if standstill is not None:
        return Verdict("failed", standstill, compared)
    if wrong := _unexpected_restart(result.restarts, plan.faults):
        return Verdict("failed", wrong, compared)
    if result.failures:
        caused = not plan.survivable and all(CONSEQUENCES.match(line) for line in result.failures)
        return Verdict("ended" if caused else "failed", result.failures[0], compared)
    if missing or twice:
        return Verdict("failed", f"{missing} states or graphs are missing, {twice} are there twice", compared)
    return Verdict("equal", f"{compared} states", compared)


def _unexpected_restart(restarts: Sequence[str], faults: Sequence[Fault]) -> str | None:
    """The first restart that no fault is the cause of."""
    kills = sum(fault.kills for fault in faults)
    crashes = [line for line in restarts if ": killed by SIGKILL" not in line]
    extra = crashes or restarts[kills:]
    return f"restarted without a fault: {extra[0]}" if extra else None
