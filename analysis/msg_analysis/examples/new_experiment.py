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

"""A new experiment file from a few choices, with comments that say what can be changed."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Kind = Literal["line", "ring", "star", "complete"]
KINDS: tuple[Kind, ...] = ("line", "ring", "star", "complete")
MOST_AGENTS = 1000  # of a new file; an experiment may have more
STEPS = 4000  # of a run whose duration is not given
COMMENT = 32  # column in which comments begin


@dataclass(frozen=True, slots=True)
class Choices:
    """What a new experiment is to be; agents count from 1. The defaults are those of ``msg-agents new``."""

    agents: int = 5  # at least 3 with a ring
    graphs: tuple[Kind, ...] = ("line", "ring")  # different ones
    time: Literal["continuous", "discrete"] = "continuous"
    switching: float = 0.5  # jumps per unit of time; in discrete time below 1: probability of a jump after a step
    noise: float = 1.0
    loss: float = 0.0
    leaders: tuple[int, ...] = ()  # none: consensus
    duration: float | None = None  # None: STEPS steps
    seed: int = 1

    @property
    def step(self) -> float:
        """Length of a step: 1, 2 or 5 times a power of ten, a quarter of the stability limit or less."""
        if self.time == "discrete":
            return 1.0
        largest = 0.5 / self._largest_eigenvalue
        steps = [float(f"{digit}e-{power}") for power in range(1, 6) for digit in (5, 2, 1)]
        return max(step for step in steps if step <= largest)

    @property
    def _largest_eigenvalue(self) -> float:
        """Bound for all graphs and the leaders' gain: 4 for a line and a ring, the number of agents for the others."""
        bound = self.agents if {"star", "complete"} & set(self.graphs) else min(self.agents, 4)
        return float(bound) + (1.0 if self.leaders else 0.0)

    @property
    def length(self) -> float:
        """Duration of the run."""
        return round(STEPS * self.step, 6) if self.duration is None else self.duration


def experiment_name(stem: str) -> str:
    """A name that an experiment may have, from that of its file."""
    name = re.sub(r"[^a-z0-9_]+", "_", stem.lower())
    return name if re.match("[a-z]", name) else f"network_{name.strip('_')}".rstrip("_")


def experiment_text(name: str, choices: Choices) -> str:
    """The file: every key that was chosen, and the defaults that are changed most often."""
    discrete, leaders = choices.time == "discrete", choices.leaders
    lines = [
        "# Agents count from 1. The defaults of keys that are not here: msg-analysis schema",
        f"name: {name}",
        _line(
            "problem:",
            "tracking" if leaders else "consensus",
            "consensus: the agents agree | tracking: they follow leaders",
        ),
        _line("time:", choices.time, "continuous: Euler steps of run.dt | discrete: W = exp(-Z), one step is 1"),
        f"agents: {choices.agents}",
        "",
        _line("graphs:", "", "the order here is the order of the modes"),
        *(_graph(kind, choices.agents) for kind in choices.graphs),
        *_switching(choices),
        "",
        "noise:",
        _line(
            "  process:", _number(choices.noise), "gain F of each agent, or a list with one for each; covariance F F^T"
        ),
        _line("  loss:", _number(choices.loss), "probability that a message is lost"),
    ]
    if leaders:
        lines += [
            "",
            "leaders:",
            _line("  agents:", _list(leaders), "they know the reference"),
            _line("  gain:", "1.0", "pull towards it; inf: held at the reference"),
            _line("  reference:", "0.0", "the value that the others follow"),
        ]
    unit = "steps" if discrete else f"{round(choices.length / choices.step)} steps"
    lines += [
        "",
        "run:",
        *([] if discrete else [_line("  dt:", _number(choices.step), "below 2 / lambda_max of every graph: see info")]),
        _line("  duration:", _number(choices.length), unit),
        _line("  replicas:", "16", "independent copies under the same graphs: narrower intervals for little work"),
        _line("  seed:", str(choices.seed), "another seed: other noise, other jumps"),
        _line("  pace:", "lockstep", "as fast as possible, repeatable | realtime: each agent on its own timer"),
    ]
    return "\n".join(lines) + "\n"


def _line(key: str, value: str, comment: str) -> str:
    """One line with a comment at its end."""
    return f"{f'{key} {value}'.rstrip():<{COMMENT - 2}}  # {comment}"


def _number(value: float) -> str:
    """A number as YAML reads it, without an unnecessary ``.0``."""
    return str(int(value)) if value == int(value) and value >= 10 else repr(float(value))


def _list(labels: Sequence[int]) -> str:
    """A list in lines of at most 120 characters."""
    return textwrap.fill(f"[{', '.join(map(str, labels))}]", 100, subsequent_indent=" " * 4)


def _graph(kind: Kind, agents: int) -> str:
    everyone = _list(range(1, agents + 1))
    given = {
        "line": f"path: {everyone}",
        "ring": f"cycle: {everyone}",
        "star": "star: {center: 1}",
        "complete": "complete: true",
    }
    return f"  {kind}: {{{given[kind]}}}"


def _switching(choices: Choices) -> list[str]:
    """The section; with one graph, a comment."""
    graphs, others = choices.graphs, len(choices.graphs) - 1
    if not others:
        return ["", "# switching: with a second graph"]
    share = choices.switching / others
    lines = ["", "switching:"]
    if choices.time == "discrete":
        lines.append(_line("  transition:", "", "probabilities between the graphs in the order above; rows sum to 1"))
        for i in range(len(graphs)):
            row = [1.0 - choices.switching if j == i else share for j in range(len(graphs))]
            lines.append(f"    - [{', '.join(map(_number, row))}]")
    else:
        lines.append(_line("  rates:", "", "from: {to: jumps per unit of time}"))
        for graph in graphs:
            to = ", ".join(f"{other}: {_number(share)}" for other in graphs if other != graph)
            lines.append(f"    {graph}: {{{to}}}")
    lines.append(_line("  initial:", "stationary", "or the name of a graph"))
    return lines
