# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Mistakes in an experiment file, one line each: ``key: value: what was expected: what to do``."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Sequence
from typing import get_args

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from msg_analysis.errors import InputError
from msg_analysis.experiment.spec import ExperimentSpec, GraphSpec

_LONGEST_VALUE = 60
_MOST_LINES = 100  # problems shown; a file with more mostly repeats one of them


class ExperimentError(InputError):
    """An experiment that is not valid.

    Attributes
    ----------
    source
        file or topic that the experiment came from
    problems
        one line for each mistake: ``key: value: what was expected: what to do``
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        self.source = source
        self.problems = list(problems)
        count = len(self.problems)
        lines = [f"{count} problems", *self.problems[:_MOST_LINES]] if count != 1 else self.problems
        if count > _MOST_LINES:
            lines.append(f"and {count - _MOST_LINES} more")
        super().__init__("\n  ".join([f"{source}: {lines[0]}", *lines[1:]]))


def problem(key: str, value: object, wanted: str, remedy: str) -> str:
    """One line about one mistake at a dotted key; a ``value`` that is a text is taken as it is."""
    return f"{key}: {value if isinstance(value, str) else show(value)}: {wanted}: {remedy}"


def show(value: object) -> str:
    """A value as the file would have it, on one line, shortened."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = repr(value)
    text = text.replace("NaN", ".nan").replace("-Infinity", "-.inf").replace("Infinity", ".inf")
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def dotted(location: Sequence[int | str]) -> str:
    """The key of pydantic's location: names joined by dots, list entries in brackets, counted from 1."""
    key = ""
    for part in location:
        if isinstance(part, int):
            key += f"[{part + 1}]"
        else:
            key += f".{part}" if key else str(part)
    return key


_EXPECTED = {
    "float_type": "expected a number",
    "finite_number": "expected a finite number",
    "int_type": "expected a whole number",
    "int_from_float": "expected a whole number",
    "string_type": "expected a text",
    "string_too_short": "expected a text that is not empty",
    "string_too_long": "expected at most {max_length} characters",
    "string_pattern_mismatch": "expected a name of the form {pattern}",
    "list_type": "expected a list",
    "dict_type": "expected keys with values",
    "model_type": "expected keys with values",
    "greater_than": "expected a number > {gt}",
    "greater_than_equal": "expected a number >= {ge}",
    "less_than": "expected a number < {lt}",
    "less_than_equal": "expected a number <= {le}",
    "too_short": "expected at least {min_length} entries",
    "literal_error": "expected {expected}",
    "expected": "expected {text}",
}


def translate(error: ErrorDetails, root: type[BaseModel] = ExperimentSpec, section: str = "") -> str:
    """One of pydantic's errors in the style of this module; ``root``: the model validated, or of a ``section``."""
    kind, location, value = error["type"], error["loc"], error["input"]
    if not location:
        location = (section or "experiment",)
    elif section:
        location = (section, *location)
    if kind == "invalid_key" or location[-1] == "[key]":
        place = dotted(location[:-1] if kind == "invalid_key" else location[:-2]) or "experiment"
        remedy = "rename it" if isinstance(value, str) else "put quotes around it"
        return problem(place, f"key {show(value)}", "expected a text without spaces around it as key", remedy)
    key = dotted(location)
    model, example = _context(location, root)
    if kind == "missing":
        return problem(key, "missing", f"expected {_description(location, root)}", example)
    if kind == "extra_forbidden":
        known = list(model.model_fields)
        meant = _meant(location, model, root, value)
        return problem(
            key,
            "unknown key",
            f"expected one of {', '.join(known)}" if known else "expected none",
            meant or _did_you_mean(location[-1], known) or "remove it",
        )
    wanted = _EXPECTED.get(kind)
    text = wanted.format(**{k: _plain(v) for k, v in error.get("ctx", {}).items()}) if wanted else error["msg"]
    options = re.findall(r"'(\w+)'", text) if kind == "literal_error" else []
    return problem(key, show(value), text, _did_you_mean(value, options) or example)


def _meant(location: Sequence[int | str], model: type[BaseModel], root: type[BaseModel], value: object) -> str | None:
    """What to write instead of a key that other programs have, or that belongs to another section."""
    key = str(location[-1])
    if model is GraphSpec and key in _OF_GRAPHS:
        return _OF_GRAPHS[key] if value is not False else "remove it: `edges` have no direction"
    if root is not ExperimentSpec:
        return None
    places = [
        section
        for section, field in ExperimentSpec.model_fields.items()
        if section not in ("graphs", "protocol") and key in getattr(_model_in(field.annotation), "model_fields", {})
    ]
    if key in ExperimentSpec.model_fields and len(location) > 1:
        places.append("")
    if len(places) != 1:
        return None
    return f"did you mean `{places[0]}.{key}`?" if places[0] else f"did you mean `{key}`, without `{location[0]}`?"


_LISTENS = "`arcs: [[1, 2]]`: agent 2 listens to agent 1"
WEIGHT = "give it as the third entry of a link, for example `edges: [[1, 2, 0.5]]`"
_OF_GRAPHS = {
    **dict.fromkeys(("directed", "digraph", "is_directed"), f"for a directed graph give {_LISTENS}"),
    "undirected": "remove it: `edges` have no direction",
    "weights": WEIGHT,
    **dict.fromkeys(("links", "edge_list"), "did you mean `edges`, or `arcs` for a directed graph?"),
    **dict.fromkeys(("nodes", "vertices", "agents"), "give the number of agents as `agents`, beside `graphs`"),
    "matrix": "did you mean `adjacency`?",
}


def _did_you_mean(value: object, options: Sequence[str]) -> str | None:
    close = difflib.get_close_matches(str(value), options, 1)
    return f"did you mean '{close[0]}'?" if close else None


def _plain(limit: object) -> object:
    """A limit without unnecessary decimals, a pattern without anchors, a boolean as YAML writes it."""
    if isinstance(limit, float):
        return f"{limit:g}"
    return str(limit).strip("^$").replace("True", "true")


def _context(location: Sequence[int | str], root: type[BaseModel]) -> tuple[type[BaseModel], str]:
    """The model that a place belongs to, and an example for the last known key of the place."""
    model = root
    example = "see `msg-analysis schema`" if root is ExperimentSpec else "see the documentation of the package"
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            continue
        if field.examples:
            example = f"for example {part}: {show(field.examples[0])}"
        model = _model_in(field.annotation) or model
    return model, example


def _model_in(annotation: object) -> type[BaseModel] | None:
    """The model in ``Section``, ``Section | None`` or ``dict[str, Section]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for inner in get_args(annotation) if (found := _model_in(inner))), None)


def _description(location: Sequence[int | str], root: type[BaseModel]) -> str:
    model, _ = _context(location[:-1], root)
    return model.model_fields[str(location[-1])].description or "a value"
