# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The points of a sweep: keys, values and their names.

Dotted keys: places in the document of an experiment.

Names are joined by dots, places in lists stand in brackets and count from 1: ``noise.process[3]``.

From a sweep file to its points: every one of them is a valid experiment before anything is computed.

All mistakes are reported together, each once, with the points that have it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from msg_analysis.common.text import agent_text
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.loading import other_kind, read_yaml
from msg_analysis.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.sweeps.points import Job, JobKind
from msg_analysis.sweeps.sweep_file import MOST_POINTS, SweepSpec

_PART = re.compile(r"([^\[\]]+)|\[(\d+)\]")


class KeyProblemError(Exception):
    """A key that cannot be set; the text is a line of problems."""


def put(document: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy of a document with another value at a place; only the containers on the way are copied.

    Names in the document may have dots in them; missing sections are made. KeyProblemError: the key leads nowhere.
    """
    parts = _split(key)
    changed = dict(document)
    _put(changed, parts, value, key, "")
    return changed


def _split(key: str) -> list[str | int]:
    """Names between dots, and places from 0."""
    parts: list[str | int] = []
    for piece in key.split("."):
        found = list(_PART.finditer(piece))
        if not found or "".join(match[0] for match in found) != piece or found[0][1] is None:
            raise KeyProblemError(_problem(key, "not a key", "names joined by dots, places in lists in brackets"))
        for match in found:
            if match[2] == "0":
                raise KeyProblemError(_problem(key, f"place {match[0]}", "places from 1"))
            parts.append(match[1] if match[1] is not None else int(match[2]) - 1)
    return parts


def _put(here: Any, parts: list[str | int], value: Any, key: str, path: str) -> None:
    """Set a value in a container that is a copy already."""
    name, used = _name(here, parts)
    rest = parts[used:]
    if isinstance(name, int):
        if not isinstance(here, list) or not name < len(here):
            size = f"{len(here)} entries" if isinstance(here, list) else show(here)
            raise KeyProblemError(_problem(key, f"{path} has {size}", f"a list with at least {name + 1} entries"))
        shown = f"{path}[{name + 1}]"
    else:
        if not isinstance(here, dict):
            raise KeyProblemError(_problem(key, f"{path} is {show(here)}", "keys with values there"))
        shown = f"{path}.{name}" if path else name
    if not rest:
        here[name] = value
        return
    inner = here[name] if isinstance(name, int) else here.get(name)
    inner = {} if inner is None else inner
    here[name] = dict(inner) if isinstance(inner, Mapping) else list(inner) if isinstance(inner, list) else inner
    _put(here[name], rest, value, key, shown)


def _name(here: Any, parts: list[str | int]) -> tuple[str | int, int]:
    """The next name and how many parts it takes: a name that is there may have dots."""
    if isinstance(parts[0], str) and isinstance(here, dict) and parts[0] not in here:
        name = parts[0]
        for count, part in enumerate(parts[1:], start=2):
            if isinstance(part, int):
                break
            name = f"{name}.{part}"
            if name in here:
                return name, count
    return parts[0], 1


def _problem(key: str, found: str, wanted: str) -> str:
    return problem(f"over.{key}", found, f"expected {wanted}", "correct the key")


_KEYS = {
    "agents": "number of agents",
    "leaders.agents": "leaders",
    "leaders.gain": "gain of the leaders",
    "leaders.reference": "reference",
    "noise.broadcast": "noise of published values",
    "noise.burst": "messages lost in a row",
    "noise.delay": "delay of messages, in steps",
    "noise.link": "noise of received values",
    "noise.loss": "loss of messages",
    "noise.loss.default": "loss of messages",
    "noise.on_loss": "in place of a lost value",
    "noise.process": "process noise",
    "problem": "problem",
    "run.dt": "step length dt",
    "run.duration": "simulated time",
    "run.pace": "pace",
    "run.delivery": "delivery",
    "run.processes": "number of processes",
    "run.replicas": "number of replicas",
    "run.seed": "seed",
    "run.speed": "speed of real time",
    "run.start": "start",
    "switching.generator": "generator",
    "switching.initial": "first graph",
    "switching.scale": "factor of the switching rates",
    "switching.transition": "transition matrix",
    "time": "time",
}
_COLUMNS = {
    "node_errors": "error of {}",
    "rate": "decay rate",
    "seconds": "computing time [s]",
    "system_certainty": "system certainty",
    "system_error": "system error",
}
_LAWS = {"continuous": "continuous time", "discrete": "discrete time", "emulated": "with steps", "static": "one graph"}


def key_words(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, such as "step length dt"; the key itself if it has none. ``names``: of the agents."""
    if key in _KEYS:
        return _KEYS[key]
    if found := re.fullmatch(r"noise\.process\[(\d+)\]", key):
        return f"process noise of {agent_text(int(found[1]), names)}"
    if found := re.fullmatch(r"switching\.rates\.([^.]+)\.([^.]+)", key):
        return f"switching rate from {found[1]} to {found[2]}"
    return key


def axis_name(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, with the key in brackets, such as "step length dt [run.dt]"."""
    words = key_words(key, names)
    return words if words == key else f"{words} [{key}]"


def column_words(column: str, names: Sequence[str] | None = None) -> str:
    """A column in words, such as "error of agent 3"; the column itself if it has none."""
    law, _, rest = column.partition(".")
    if law in _LAWS and rest:
        return f"{column_words(rest, names)}, {_LAWS[law]}"
    found = re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", column)
    words = _COLUMNS.get(found[1]) if found else None
    if found is None or words is None or ("{}" in words) != (found[2] is not None):
        return column
    return words.format(agent_text(int(found[2]), names)) if found[2] else words


SEED = "run.seed"
_NAMED = 3  # points that a problem names

Checked = Callable[[int, int], None]  # progress: how many combinations of how many have been checked


@dataclass(frozen=True, slots=True)
class Point:
    """One run, or one prediction."""

    values: Mapping[str, Any]  # of the swept keys
    repetition: int | None  # from 0; None for predictions
    seed: int | None  # None for predictions
    job: Job


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep whose points are all valid."""

    name: str  # of the file, without its ending
    spec: SweepSpec
    experiment: str  # name of the experiment
    points: tuple[Point, ...]  # in the order of the file: first key slowest, repetitions fastest
    names: Sequence[str] | None = None  # of the agents, if all points have the same

    @property
    def kind(self) -> JobKind:
        """What is done at every point."""
        return self.spec.kind

    @property
    def keys(self) -> tuple[str, ...]:
        """The swept keys."""
        return tuple(self.spec.over)


def load_sweep(path: str | Path, checked: Checked = lambda _done, _total: None) -> Sweep:
    """Read a sweep file (YAML; JSON is YAML too) and check every point of it.

    InputError: it, or the file of the experiment, cannot be read. ExperimentError: all mistakes, with their points.
    """
    path = Path(path)
    mapping = read_yaml(path)
    if not isinstance(mapping, Mapping):
        lines = [problem("sweep", show(mapping), "expected keys with values", "start with `experiment:`")]
        raise ExperimentError(str(path), lines)
    if instead := other_kind(mapping, "sweep"):
        raise ExperimentError(str(path), [f"is {instead}"])
    try:
        spec = SweepSpec.model_validate(dict(mapping))
    except ValidationError as error:
        found = [translate(detail, SweepSpec) for detail in error.errors(include_url=False)]
        raise ExperimentError(str(path), found) from error
    directory = path.parent
    base: Any = spec.experiment
    if isinstance(base, str):
        file = find(base, directory)
        directory = file.parent
        base = read_yaml(file)
        if not isinstance(base, Mapping):
            raise ExperimentError(
                str(path), [problem("experiment", show(base), "expected a file of keys", "correct it")]
            )
    return points_of(path, spec, base, directory, checked)


def _spec_problems(spec: SweepSpec) -> list[str]:
    """Mistakes in several keys of the sweep file together."""
    found = []
    lengths = {key: len(values) for key, values in spec.over.items()}
    if spec.combine == "zip" and len(set(lengths.values())) > 1:
        text = ", ".join(f"{key}: {length}" for key, length in lengths.items())
        found.append(problem("over", text, "expected as many values of every key with combine: zip", "or use grid"))
    if spec.kind == "predict" and spec.repetitions > 1:
        wanted = "expected 1: a prediction does not depend on chance"
        found.append(problem("repetitions", spec.repetitions, wanted, "remove it, or use kind: simulate"))
    if spec.until and spec.kind != "network":
        wanted = "expected none: only a network can end early"
        found.append(problem("until", spec.until, wanted, "remove it, or use kind: network"))
    if SEED in spec.over and spec.repetitions > 1:
        found.append(problem("repetitions", spec.repetitions, f"expected 1, since {SEED} is swept", "use one of both"))
    total = spec.repetitions
    for length in lengths.values() if spec.combine == "grid" else [max(lengths.values())]:
        total *= length
    if total > MOST_POINTS:
        found.append(problem("over", f"{total} points", f"expected at most {MOST_POINTS}", "sweep fewer values"))
    return found


def _combinations(spec: SweepSpec) -> Iterator[dict[str, Any]]:
    joined = itertools.product(*spec.over.values()) if spec.combine == "grid" else zip(*spec.over.values(), strict=True)
    for values in joined:
        yield dict(zip(spec.over, values, strict=True))


def points_of(path: Path, spec: SweepSpec, base: Mapping[str, Any], directory: Path, checked: Checked) -> Sweep:
    """The sweep of a document; every point is checked. ExperimentError: all mistakes, with their points."""
    if lines := _spec_problems(spec):
        raise ExperimentError(str(path), lines)
    combinations = list(_combinations(spec))
    wrong: dict[str, list[int]] = {}  # line: indices of the combinations that have it
    points: list[Point] = []
    name, named = "", set()
    for number, values in enumerate(combinations):
        document: Mapping[str, Any] = base
        try:
            for key, value in values.items():
                document = put(document, key, value)
            experiment = Experiment.parse(document, source=str(path), directory=directory)
            lines = experiment.unavailable("predict" if spec.kind == "predict" else "run")
        except KeyProblemError as error:
            lines = [str(error)]
        except ExperimentError as error:
            lines = error.problems
        for line in lines:
            wrong.setdefault(line, []).append(number)
        if not wrong:
            name = experiment.name
            named.add(tuple(experiment.names or ()))
            points += _runs(spec, values, experiment)
        checked(number + 1, len(combinations))
    if wrong:
        raise ExperimentError(str(path), _grouped(wrong, combinations))
    (names,) = named if len(named) == 1 else [()]
    return Sweep(path.stem, spec, name, tuple(points), names or None)


def _runs(spec: SweepSpec, values: Mapping[str, Any], experiment: Experiment) -> Iterator[Point]:
    document = experiment.to_document()
    if spec.kind == "predict":
        yield Point(values, None, None, Job.of("predict", document))
        return
    for repetition in range(spec.repetitions):
        seed = experiment.run.seed
        if SEED not in values:
            seed = seed + repetition if spec.seeds == "common" else own_seed(seed, values, repetition)
        document["run"]["seed"] = seed
        yield Point(values, repetition, seed, Job.of(spec.kind, document, spec.level, spec.until))


def own_seed(seed: int, values: Mapping[str, Any], repetition: int) -> int:
    """Seed below 2**32 of one run; it depends on the arguments only, so it stays when other points come or go."""
    text = json.dumps([seed, dict(values), repetition], sort_keys=True)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")


def label(values: Mapping[str, Any]) -> str:
    """A point in words: the swept keys and their values."""
    return ", ".join(f"{key} = {show(value)}" for key, value in values.items())


def _grouped(wrong: Mapping[str, Sequence[int]], combinations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Each problem once, with the points that have it."""
    lines = []
    for line, numbers in wrong.items():
        if len(numbers) == len(combinations) > 1:
            lines.append(f"every point: {line}")
            continue
        named = "; ".join(f"point {number + 1} ({label(combinations[number])})" for number in numbers[:_NAMED])
        more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
        lines.append(f"{named}{more}: {line}")
    return lines
