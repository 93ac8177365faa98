# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The sweep file and its grid: every point is checked before anything is computed; all mistakes are told together."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, ValidationError

from msg_analysis.errors import InputError
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.limits import prediction_method, unavailable
from msg_analysis.experiment.loading import other_kind, read_yaml
from msg_analysis.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.experiment.values import Count, expected, is_number
from msg_analysis.model.run_record import Until
from msg_analysis.sweeps.points import Job, JobKind

MOST_POINTS = 20_000  # of a sweep: the experiments of all are held in memory

_KEYS = {"values", "from", "to", "count", "step", "spacing"}
_FORMS = "a list of values, {from, to, count}, {from, to, count, spacing: log} or {from, to, step}"


class Axis(list[Any]):
    """The values of a key, in order."""

    logarithmic: bool | None = None  # spacing, which a figure then follows; None: not stated


def _axis(value: object) -> Axis:
    """The values that a list or a range stands for."""
    if isinstance(value, Axis):
        return value
    if isinstance(value, list):
        value = {"values": value}
    if not isinstance(value, dict) or not value or not set(value) <= _KEYS:
        raise expected(_FORMS)
    if "values" in value:
        listed = value["values"]
        if len(value) > 1 or not isinstance(listed, list) or not listed:
            raise expected("values to be a list with at least one entry, and no other key")
        return Axis(listed)
    if not is_number(value.get("from")) or not is_number(value.get("to")) or ("count" in value) == ("step" in value):
        raise expected("numbers `from` and `to`, and either `count` or `step`")
    return _range(float(value["from"]), float(value["to"]), value)


def _range(first: float, last: float, value: dict[str, Any]) -> Axis:
    spacing = value.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise expected("spacing to be linear or log")
    whole = all(isinstance(value[key], int) for key in ("from", "to", "step") if key in value)
    if "step" in value:
        step = value["step"]
        if not is_number(step) or step == 0 or (last - first) / step < 0 or spacing == "log":
            raise expected("step to lead from `from` to `to`, with linear spacing")
        count = math.floor((last - first) / step * (1 + 1e-12) + 1e-12) + 1
    else:
        count = value["count"]
        if not isinstance(count, int) or isinstance(count, bool) or count < 1 or (count == 1 and first != last):
            raise expected("count to be a whole number >= 2")
    if count > MOST_POINTS:
        raise expected(f"at most {MOST_POINTS} values")
    if spacing == "log":
        if first <= 0 or last <= 0:
            raise expected("`from` and `to` > 0 with spacing: log")
        numbers = np.geomspace(first, last, count)
    elif "step" in value:
        numbers = np.asarray(first + float(value["step"]) * np.arange(count), dtype=float)
    else:
        numbers = np.linspace(first, last, count)
    # Without the last digits, which are rounding: 0.30000000000000004.
    axis = Axis(float(f"{number:.12g}") for number in numbers)
    if whole and spacing == "linear" and all(number.is_integer() for number in axis):
        axis = Axis(int(number) for number in axis)
    axis.logarithmic = spacing == "log"
    return axis


_RangeSchema = dict[Literal["values", "from", "to", "count", "step", "spacing"], Any]


def _experiment(value: object) -> str | dict[str, Any]:
    if (isinstance(value, str) and value) or (isinstance(value, dict) and value):
        return value
    raise expected("the name of a file, or the keys of an experiment")


def _precision(value: str) -> str:
    with suppress(InputError):
        until = Until.parse(value)
        if not until.decided:  # the runs of a sweep are tested together
            return str(until)
    raise expected("a precision such as 5%")


class SweepSpec(BaseModel):
    """One experiment at many values of its keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    experiment: Annotated[
        str | dict[str, Any], PlainValidator(_experiment, json_schema_input_type=str | dict[str, Any])
    ] = Field(
        description="an experiment file, relative to this file, the name of an example, or the experiment itself",
        examples=["line_ring"],
    )
    kind: JobKind = Field(
        "predict",
        description="at every point: predict the errors; simulate a run with the offline twin and compare it; or run a "
        "network of ROS 2 processes and compare it",
        examples=["predict"],
    )
    over: dict[str, Annotated[Axis, PlainValidator(_axis, json_schema_input_type=list[Any] | _RangeSchema)]] = Field(
        min_length=1,
        description="keys of the experiment, with dots, and their values: a list, or a range {from, to, count} with "
        "spacing linear or log, or {from, to, step}",
        examples=[{"switching.scale": {"from": 0.1, "to": 10, "count": 9, "spacing": "log"}}],
    )
    combine: Literal["grid", "zip"] = Field(
        "grid",
        description="grid: every value of a key with every value of the others; zip: the first values together, then "
        "the second, and so on",
        examples=["grid"],
    )
    repetitions: Count = Field(
        1, description="runs at every point, each with a seed of its own (simulate, network)", examples=[5]
    )
    seeds: Literal["independent", "common"] = Field(
        "independent",
        description="independent: every run has its own seed, made of run.seed and its point; common: run.seed, "
        "run.seed + 1, ... at every point, so that differences between points are seen better",
        examples=["independent"],
    )
    until: Annotated[str, AfterValidator(_precision)] | None = Field(
        None,
        description="network: every run ends when its system error is known to this precision, at its duration at "
        "the latest",
        examples=["5%"],
    )
    level: Annotated[float, Field(strict=True, gt=0, le=0.5)] = Field(
        0.01, description="probability of a false 'disagrees', all runs together", examples=[0.01]
    )


def json_schema() -> dict[str, Any]:
    """JSON Schema of the sweep file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | SweepSpec.model_json_schema()


_PART = re.compile(r"([^\[\]]+)|\[(\d+)\]")


class KeyProblemError(Exception):
    """A key that cannot be set; the text is a line of problems."""


def put(document: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy of a document with another value at a place, in new sections if need be; KeyProblemError: nowhere."""
    changed = dict(document)
    _put(changed, _split(key), value, key, "")
    return changed


def _split(key: str) -> list[str | int]:
    """Names between dots, and places from 0."""
    parts: list[str | int] = []
    for piece in key.split("."):
        found = list(_PART.finditer(piece))
        if not found or "".join(match[0] for match in found) != piece or found[0][1] is None:
            raise _problem(key, "not a key", "names joined by dots, places in lists in brackets")
        for match in found:
            if match[2] == "0":
                raise _problem(key, f"place {match[0]}", "places from 1")
            parts.append(match[1] if match[1] is not None else int(match[2]) - 1)
    return parts


def _put(here: Any, parts: list[str | int], value: Any, key: str, path: str) -> None:
    """Set a value in a container that is a copy already."""
    name, used = _name(here, parts)
    rest = parts[used:]
    if isinstance(name, int):
        if not isinstance(here, list) or not name < len(here):
            size = f"{len(here)} entries" if isinstance(here, list) else show(here)
            raise _problem(key, f"{path} has {size}", f"a list with at least {name + 1} entries")
        shown = f"{path}[{name + 1}]"
    else:
        if not isinstance(here, dict):
            raise _problem(key, f"{path} is {show(here)}", "keys with values there")
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


def _problem(key: str, found: str, wanted: str) -> KeyProblemError:
    return KeyProblemError(problem(f"over.{key}", found, f"expected {wanted}", "correct the key"))


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
class SweepGrid:
    """A sweep whose points are all valid."""

    name: str  # of the file, without its ending
    spec: SweepSpec
    experiment: str  # name of the experiment
    points: tuple[Point, ...]  # in the order of the file: first key slowest, repetitions fastest
    names: Sequence[str] | None = None  # of the agents, if all points have the same
    notes: tuple[str, ...] = ()  # of the experiments

    @property
    def kind(self) -> JobKind:
        """What is done at every point."""
        return self.spec.kind

    @property
    def keys(self) -> tuple[str, ...]:
        """The swept keys."""
        return tuple(self.spec.over)


def load_sweep(path: str | Path, checked: Checked = lambda _done, _total: None) -> SweepGrid:
    """Read a sweep file in YAML or JSON. InputError: a file cannot be read; ExperimentError: all mistakes."""
    path = Path(path)
    mapping = read_yaml(path)
    if not isinstance(mapping, Mapping):
        lines = [problem("sweep", show(mapping), "expected keys with values", "start with `experiment:`")]
        raise ExperimentError(str(path), lines)
    if instead := other_kind(mapping, "sweep"):
        raise ExperimentError(str(path), [f"is {instead}"])
    spec = spec_of(mapping, str(path))
    directory, base = path.parent, spec.experiment
    if isinstance(base, str):
        file = find(base, directory)
        directory, base = file.parent, read_yaml(file)
        if not isinstance(base, Mapping):
            raise ExperimentError(
                str(path), [problem("experiment", show(base), "expected a file of keys", "correct it")]
            )
    return points_of(path, spec, base, directory, checked)


def spec_of(mapping: Mapping[Any, Any], source: str) -> SweepSpec:
    """The keys of a sweep; ExperimentError: all mistakes."""
    try:
        return SweepSpec.model_validate(dict(mapping))
    except ValidationError as error:
        found = [translate(detail, SweepSpec) for detail in error.errors(include_url=False)]
        raise ExperimentError(source, found) from error


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
    total = spec.repetitions * (math.prod(lengths.values()) if spec.combine == "grid" else max(lengths.values()))
    if total > MOST_POINTS:
        found.append(problem("over", f"{total} points", f"expected at most {MOST_POINTS}", "sweep fewer values"))
    return found


def points_of(path: Path, spec: SweepSpec, base: Mapping[str, Any], directory: Path, checked: Checked) -> SweepGrid:
    """The sweep of a document; every point is checked. ExperimentError: all mistakes, with their points."""
    if lines := _spec_problems(spec):
        raise ExperimentError(str(path), lines)
    axes = spec.over.values()
    joined = itertools.product(*axes) if spec.combine == "grid" else zip(*axes, strict=True)
    combinations = [dict(zip(spec.over, values, strict=True)) for values in joined]
    wrong: dict[str, list[int]] = {}  # line: indices of the combinations that have it
    points: list[Point] = []
    name, named = "", set()
    notes: dict[str, None] = {}
    for number, values in enumerate(combinations):
        document: Mapping[str, Any] = base
        try:
            for key, value in values.items():
                document = put(document, key, value)
            experiment = Experiment.parse(document, source=str(path), directory=directory)
            lines = unavailable(experiment, "predict" if spec.kind == "predict" else "run")
            if spec.kind == "predict" and prediction_method(experiment)[0] == "sampled":
                lines = []
        except KeyProblemError as error:
            lines = [str(error)]
        except ExperimentError as error:
            lines = error.problems
        for line in lines:
            wrong.setdefault(line, []).append(number)
        if not wrong:
            name = experiment.name
            named.add(tuple(experiment.names or ()))
            notes |= dict.fromkeys(experiment.notes)
            points += _runs(spec, values, experiment)
        checked(number + 1, len(combinations))
    if wrong:
        raise ExperimentError(str(path), _grouped(wrong, combinations))
    (names,) = named if len(named) == 1 else [()]
    return SweepGrid(path.stem, spec, name, tuple(points), names or None, tuple(notes))


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


def _grouped(wrong: Mapping[str, Sequence[int]], combinations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Each problem once, with the points that have it."""
    lines = []
    for line, numbers in wrong.items():
        named = []
        for number in numbers[:_NAMED]:
            values = ", ".join(f"{key} = {show(value)}" for key, value in combinations[number].items())
            named.append(f"point {number + 1} ({values})")
        more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
        every = len(numbers) == len(combinations) > 1
        lines.append(f"every point: {line}" if every else f"{'; '.join(named)}{more}: {line}")
    return lines
