# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The examples that are installed with this package, and new experiment files."""

from __future__ import annotations

import difflib
import os
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msg_analysis.errors import InputError

FOLDER = Path(__file__).parent / "bundled"
SUFFIX = ".yaml"


def names() -> list[str]:
    """Names of all examples, sorted."""
    return sorted(file.stem for file in FOLDER.glob(f"*{SUFFIX}"))


def trace_of(name: str) -> str | None:
    """Name of the file that an example reads, beside its own; None: it reads none."""
    file = FOLDER / f"{name}.csv"
    return file.name if file.is_file() else None


def text_of(name: str) -> str:
    """The file of an example, or one that an example reads; InputError: there is none of this name."""
    if name in map(trace_of, names()):
        return (FOLDER / name).read_text(encoding="utf-8")
    if name not in names():
        raise InputError(f"{name}: no example of this name: expected one of {_listed(name)}")
    return (FOLDER / f"{name}{SUFFIX}").read_text(encoding="utf-8")


def shows(name: str) -> str:
    """What an example shows: the first sentence of the comment at its top; of another file, what reads it."""
    if name not in names() and name in map(trace_of, names()):
        return f"The trace of {Path(name).stem}"
    comment = []
    for line in text_of(name).splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    first, _, _ = " ".join(comment).partition(". ")
    return first.rstrip(".")


def find(given: str | Path, folder: Path = Path()) -> Path:
    """The file of an experiment: ``given``, relative to ``folder``, or an example. InputError: neither."""
    # A file wins over an example, also with the ending .yaml. What has a slash or an ending is a path, not checked.
    word = str(given)
    if not word:
        raise InputError(f"no experiment: the text is empty: expected a file, or one of {', '.join(names())}")
    path = folder / word
    if os.sep in word or word in (os.curdir, os.pardir) or (path.exists() and not path.is_dir()):
        return path
    if path.suffix:
        if path.suffix == SUFFIX and path.stem in names():
            raise InputError(f"{path}: no such file: check the path, or give {path.stem}, the example of this name")
        return path
    if (own := path.with_name(f"{word}{SUFFIX}")).is_file():
        return own
    if word in names():
        return FOLDER / f"{word}{SUFFIX}"
    if path.is_dir():
        return path
    raise InputError(f"{word}: no such file, and no example of this name: expected a file, or one of {_listed(word)}")


def _listed(word: str) -> str:
    """All names, and the one that may be meant."""
    close = difflib.get_close_matches(word, names(), 1)
    return ", ".join(names()) + (f": did you mean {close[0]}?" if close else "")


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
    problem, noise = "tracking" if leaders else "consensus", _number(choices.noise)
    lines = [
        "# Agents count from 1. The defaults of keys that are not here: msg-analysis schema",
        f"name: {name}",
        _line("problem:", problem, "consensus: the agents agree | tracking: they follow leaders"),
        _line("time:", choices.time, "continuous: Euler steps of run.dt | discrete: W = exp(-Z), one step is 1"),
        f"agents: {choices.agents}",
        "",
        _line("graphs:", "", "the order here is the order of the modes"),
        *(_graph(kind, choices.agents) for kind in choices.graphs),
        *_switching(choices),
        "",
        "noise:",
        _line("  process:", noise, "gain F of each agent, or a list with one for each; covariance F F^T"),
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
