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

"""From a sweep file to its points: every one of them is a valid experiment before anything is computed.

All mistakes are reported together, each once, with the points that have it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from msg_analysis.examples.bundled import find
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.model.experiment.yaml_document import other_kind, read_yaml
from msg_analysis.sweep.dotted_keys import KeyProblemError, put
from msg_analysis.sweep.jobs.job import Job, JobKind
from msg_analysis.sweep.sweep_file import MOST_POINTS, SweepSpec

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
    lines = _spec_problems(spec)
    if lines:
        raise ExperimentError(str(path), lines)
    return _plan(path, spec, base, directory, checked)


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


def _plan(path: Path, spec: SweepSpec, base: Mapping[str, Any], directory: Path, checked: Checked) -> Sweep:
    combinations = list(_combinations(spec))
    wrong: dict[str, list[int]] = {}  # line: indices of the combinations that have it
    points: list[Point] = []
    name, named = "", set()
    for number, values in enumerate(combinations):
        document: Mapping[str, Any] = base
        try:
            for key, value in values.items():
                document = put(document, key, value)
            experiment = ValidExperiment.parse(document, source=str(path), directory=directory)
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


def _runs(spec: SweepSpec, values: Mapping[str, Any], experiment: ValidExperiment) -> Iterator[Point]:
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
