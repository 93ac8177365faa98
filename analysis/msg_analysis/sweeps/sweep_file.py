# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The sweep file as data: what is swept, over which values, and what is done at every point."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator

from msg_analysis.errors import InputError
from msg_analysis.experiment.network_spec import Count, expected, is_number
from msg_analysis.model.run_record import Until
from msg_analysis.sweeps.points import JobKind

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
    first, last = value.get("from"), value.get("to")
    if not is_number(first) or not is_number(last) or ("count" in value) == ("step" in value):
        raise expected("numbers `from` and `to`, and either `count` or `step`")
    return _range(float(first), float(last), value)  # type: ignore[arg-type]


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
        numbers = first + float(value["step"]) * np.arange(count)
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
    try:
        until = Until.parse(value)
    except InputError as error:
        raise expected("a precision such as 5%") from error
    if until.decided:  # the tests of a sweep are judged together
        raise expected("a precision such as 5%")
    return str(until)


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
