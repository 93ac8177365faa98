# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a figure of a sweep shows: one column of its table over a swept key, for each value of the other keys.

Repetitions are taken together: the mean, and the 95 % interval of the mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from msg_analysis.common.text import HALF_WIDTH_95
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import show
from msg_analysis.sweeps.grid import Sweep, key_words
from msg_analysis.sweeps.results import Row, column_names, is_number

DEFAULT_COLUMN = "system_error"


@dataclass(frozen=True, slots=True)
class Place:
    """The rows of one combination of values, repetitions taken together."""

    x: Any  # value of the key along the axis
    value: float | None  # mean over the repetitions
    low: float | None  # 95 % interval of a measured value
    high: float | None
    predicted: float | None  # mean of the exact expectations of what is measured
    reference: float | None  # of a predicted value: the same in continuous time
    reason: str | None = None  # why there is no value


@dataclass(frozen=True, slots=True)
class Series:
    """Places along the axis."""

    values: tuple[tuple[str, Any], ...]  # of the other keys that have several
    places: tuple[Place, ...]  # in the order of the axis

    @property
    def label(self) -> str:
        """Keys and values; empty where there are none."""
        return ", ".join(f"{key} = {value_text(value)}" for key, value in self.values)


@dataclass(frozen=True, slots=True)
class Picture:
    """What is drawn."""

    x: str  # the key along the axis
    y: str  # the column
    logarithmic: bool  # the axis of x
    measured: bool  # whether there are intervals
    series: tuple[Series, ...]  # one for each combination of values of the other keys
    names: Sequence[str] | None = None  # of the agents, if all points have the same

    def words(self, values: Iterable[tuple[str, Any]]) -> str:
        """Keys in words, with their values; empty where there are none."""
        return ", ".join(f"{key_words(key, self.names)} = {value_text(value)}" for key, value in values)

    @property
    def numeric(self) -> bool:
        """Whether all values along the axis are numbers."""
        return all(is_number(place.x) for series in self.series for place in series.places)


def several_values(sweep: Sweep) -> list[str]:
    """The keys with several values, in the order of the file."""
    return [key for key, values in sweep.spec.over.items() if len(values) > 1]


def picture(sweep: Sweep, rows: Sequence[Row], column: str | None = None, along: str | None = None) -> Picture:
    """Choose what to draw of ``rows_of``; InputError where there is no such column of numbers.

    ``along``: the key along the axis, by default the first one with several values. ``column`` may be the beginning of
    a name: ``system_error`` stands for what is measured or predicted of it.
    """
    wanted = column or DEFAULT_COLUMN
    names = _columns(rows, wanted)
    if not names["value"]:
        if column is None:  # nothing but failures
            names["value"] = wanted
        else:
            raise InputError(f"column {wanted}: not a column of numbers: expected one of {_offer(rows)}")
    several = several_values(sweep)
    along = along or next(iter(several), sweep.keys[0])
    others = [key for key in several if key != along] if sweep.spec.combine == "grid" else []
    groups: dict[tuple[str, ...], dict[str, list[Row]]] = {}
    values: dict[tuple[str, ...], tuple[tuple[str, Any], ...]] = {}
    for row in rows:
        group = tuple(show(row[key]) for key in others)
        values.setdefault(group, tuple((key, row[key]) for key in others))
        groups.setdefault(group, {}).setdefault(show(row[along]), []).append(row)
    found = tuple(
        Series(values[group], tuple(_place(along, rows_here, names) for rows_here in places.values()))
        for group, places in groups.items()
    )
    return Picture(along, wanted, _logarithmic(sweep, along), names["error"] is not None, found, sweep.names)


def value_text(value: Any) -> str:
    """A value of a key for a table or a label: numbers with six digits."""
    return f"{value:.6g}" if isinstance(value, float) else show(value)


def _columns(rows: Sequence[Row], wanted: str) -> dict[str, str | None]:
    """Names of the columns of a value, its standard error, its expectation and its reference; None: not there."""
    numeric = {name for name in column_names(rows) if _numeric(rows, name)}
    for value, error, predicted, reference in (
        (f"{wanted}.measured", f"{wanted}.standard_error", f"{wanted}.predicted", None),
        (f"emulated.{wanted}", None, None, f"continuous.{wanted}"),
        (f"discrete.{wanted}", None, None, None),
        (wanted, None, None, None),
    ):
        if value in numeric:
            names = {"value": value, "error": error, "predicted": predicted, "reference": reference}
            return {key: name if name in numeric else None for key, name in names.items()}
    return dict.fromkeys(("value", "error", "predicted", "reference"))


def _numeric(rows: Sequence[Row], name: str) -> bool:
    given = [row[name] for row in rows if row.get(name) is not None]
    return bool(given) and all(map(is_number, given))


def _offer(rows: Sequence[Row]) -> str:
    """Names of columns of numbers; those of agents other than the first are left out."""
    short = {name.removesuffix(".measured") for name in column_names(rows) if _numeric(rows, name)}
    return ", ".join(sorted(name for name in short if "[" not in name or "[1]" in name))


def _place(along: str, rows: Sequence[Row], names: Mapping[str, str | None]) -> Place:
    value = _mean(rows, names["value"])
    errors = _numbers(rows, names["error"])
    half = HALF_WIDTH_95 * math.hypot(*errors) / len(errors) if errors else None
    return Place(
        x=rows[0][along],
        value=value,
        low=None if value is None or half is None else value - half,
        high=None if value is None or half is None else value + half,
        predicted=_mean(rows, names["predicted"]),
        reference=_mean(rows, names["reference"]),
        reason=next((row["reason"] for row in rows if row.get("reason")), None) if value is None else None,
    )


def _numbers(rows: Sequence[Row], name: str | None) -> list[float]:
    return [float(row[name]) for row in rows if row.get(name) is not None] if name else []


def _mean(rows: Sequence[Row], name: str | None) -> float | None:
    numbers = _numbers(rows, name)
    return math.fsum(numbers) / len(numbers) if numbers else None


def _logarithmic(sweep: Sweep, along: str) -> bool:
    """As the file says; else whether all values are numbers > 0 that span a factor of 50 or more."""
    axis = sweep.spec.over[along]
    if axis.logarithmic is not None:
        return axis.logarithmic
    numbers = list(filter(is_number, axis))
    return len(numbers) == len(axis) and min(numbers) > 0 and max(numbers) / min(numbers) >= 50
