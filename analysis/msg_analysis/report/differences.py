# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Differences of two bags or two experiments: the documents of ``diff``, and their terminal text."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from msg_analysis.bags.reading import read_bag
from msg_analysis.common.arrays import BLOCK_NUMBERS, BoolArray, FloatArray, IntArray, release
from msg_analysis.common.files import RESULT_FILE
from msg_analysis.common.resources import tell
from msg_analysis.common.text import (
    HALF_WIDTH_95,
    agent_name,
    agent_text,
    counted,
    listed,
    measured_text,
    number_text,
    percent,
    z_text,
)
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.problems import show
from msg_analysis.inference.comparison import flat
from msg_analysis.inference.pool import compare
from msg_analysis.model.run import Run
from msg_analysis.report.comparison_text import agent_errors
from msg_analysis.report.tables import fact_table, number_table, print_errors, print_rows, print_table
from msg_analysis.runs import read_document, result_row, tested_error
from msg_analysis.theory.leader_search import SearchProgress
from msg_analysis.theory.leaders import AUTO_SETS, select_leaders
from msg_analysis.theory.prediction import LAW_NAMES, Moments, Prediction, predict
from msg_analysis.theory.settling import asymptotic_rates


def state_difference(a: Run, b: Run, *, block_numbers: int = BLOCK_NUMBERS) -> dict[str, Any]:
    """The key ``states`` of the difference of two runs: missing in both is equal, +0 and -0 are different."""
    if a.states.shape[1:] != b.states.shape[1:]:
        shapes = [run.states.shape[1:] for run in (a, b)]
        why = " and ".join(f"{agents} agents with {counted(width, 'number')} each" for agents, width in shapes)
        return {"compared": None, "why": why, "equal": None, **dict.fromkeys(_KEYS)}
    steps = min(len(a.states), len(b.states)) - 1
    found = _Differences(a.record.experiment.step_length)
    numbers = 4 * max(1, a.states[:1].size)
    length = max(1, block_numbers // numbers)
    for first in range(0, steps + 1, length):
        tell("comparing states", first, steps + 1)
        block = slice(first, min(first + length, steps + 1))
        found.add(first, a.states[block], b.states[block])
        for array in (a.states, b.states):
            release(array)
    return {
        "compared": steps,
        "why": None,
        "equal": not found.states and not found.only_a and not found.only_b and len(a.states) == len(b.states),
        **{key: getattr(found, key) for key in _KEYS},
    }


def graph_difference(a: Run, b: Run) -> dict[str, Any] | None:
    """First step in which the runs used different graphs, and the names of these; None: there is none."""
    names_a, names_b = ([graph.name for graph in run.record.experiment.graph_list] for run in (a, b))
    steps = min(len(a.modes), len(b.modes))
    places = np.array([names_a.index(name) if name in names_a else -2 for name in names_b] + [-1])  # -1: not known
    there: IntArray = places[b.modes[:steps]]
    known = (a.modes[:steps] >= 0) & (b.modes[:steps] >= 0)
    differs = known & (a.modes[:steps] != there)
    if not differs.any():
        return None
    step = int(np.argmax(differs))
    return {"step": step, "a": names_a[a.modes[step]], "b": names_b[b.modes[step]], "steps": int(differs.sum())}


_KEYS = ("first", "largest", "last", "steps", "states", "only_a", "only_b")


@dataclass(slots=True)
class _Differences:
    """What the blocks so far have shown."""

    step_length: float
    first: dict[str, Any] | None = None  # step that differs: its time, agents, and largest difference
    largest: dict[str, Any] | None = None  # difference of all
    last: dict[str, Any] | None = None  # the newest step of which both runs have all states: largest difference
    steps: int = 0  # that differ
    states: int = 0  # that differ, of one agent each
    only_a: int = 0  # states that only one run has
    only_b: int = 0

    def add(self, begin: int, a: FloatArray, b: FloatArray) -> None:
        """Take the states (steps, agents, width) of both runs, from step ``begin`` on."""
        has_a, has_b = (np.asarray(~np.isnan(states).any(axis=2)) for states in (a, b))  # (steps, agents)
        self.only_a += int((has_a & ~has_b).sum())
        self.only_b += int((has_b & ~has_a).sum())
        both = has_a & has_b
        bits = (np.ascontiguousarray(a).view(np.int64) != np.ascontiguousarray(b).view(np.int64)).any(axis=2)
        differs: BoolArray = both & bits
        whole = np.flatnonzero(both.all(axis=1))
        if len(whole):
            end = int(whole[-1])
            self.last = {"step": begin + end, "difference": float(np.abs(a[end] - b[end]).max(initial=0.0))}
        if not differs.any():
            return
        self.states += int(differs.sum())
        self.steps += int(differs.any(axis=1).sum())
        sizes = np.where(differs[:, :, None], np.abs(a - b), -1.0)
        if self.first is None:
            step = int(np.argmax(differs.any(axis=1)))
            self.first = {
                "step": begin + step,
                "time": (begin + step) * self.step_length,
                "agents": (np.flatnonzero(differs[step]) + 1).tolist(),
                "difference": float(sizes[step].max()),
            }
        size = float(sizes.max())
        if self.largest is None or size > self.largest["difference"]:
            place = [int(index) for index in np.unravel_index(int(np.argmax(sizes)), sizes.shape)]
            self.largest = {"step": begin + place[0], "agent": place[1] + 1, "number": place[2] + 1, "difference": size}


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The keys whose values differ, in the order of ``a``: ``key``, ``a``, ``b``; None where one does not have it."""
    return [
        {"key": key, "a": a.get(key), "b": b.get(key)}
        for key in [*a, *(key for key in b if key not in a)]
        if a.get(key) != b.get(key)
    ]


def relative(a: float | None, b: float | None) -> dict[str, float | None]:
    """Two numbers, and their difference relative to ``a``; None where that is 0, or one is not there."""
    known = a is not None and b is not None
    return {"a": a, "b": b, "relative": (b - a) / abs(a) if known and a and b is not None else None}


def measured(a: Mapping[str, Any] | None, b: Mapping[str, Any] | None) -> dict[str, Any]:
    """Two measured errors of independent runs: their difference, its standard error, and it in standard errors."""
    one, other = a or {}, b or {}
    difference = error = None
    if one.get("measured") is not None and other.get("measured") is not None:
        difference = other["measured"] - one["measured"]
    if one.get("standard_error") is not None and other.get("standard_error") is not None:
        error = math.hypot(one["standard_error"], other["standard_error"])
    z = difference / error if difference is not None and error else None
    return {"a": a, "b": b, "difference": difference, "standard_error": error, "z": z}


MOST_AGENTS = 100  # with which leaders are searched: each set takes up to half a second
_RATES = ("mean", "second_moment", "graph")


def experiment_difference(a: Experiment, b: Experiment, watch: SearchProgress | None = None) -> dict[str, Any]:
    """The document of ``diff`` of two experiments; ``watch``: of the search of leaders."""
    pair = (a, b)
    found = [_prediction(experiment) for experiment in pair]
    laws = [_laws(prediction) if isinstance(prediction, Prediction) else {} for prediction in found]
    rates = [_rates(prediction) if isinstance(prediction, Prediction) else {} for prediction in found]
    return {
        "kind": "experiments",
        **{name: _side(*each) for name, each in zip("ab", zip(pair, found, strict=True), strict=True)},
        "keys": differing(*(flat(experiment.to_document()) for experiment in pair)),
        "predictions": {law: _errors(*(side.get(law) for side in laws)) for law in {**laws[0], **laws[1]}},
        "rates": {key: relative(*(side.get(key) for side in rates)) for key in _RATES},
        "leaders": dict(zip("ab", _leaders(a, b, found, watch), strict=True)),
    }


def _side(experiment: Experiment, prediction: Prediction | str) -> dict[str, Any]:
    return {
        "file": experiment.source,
        "name": experiment.name,
        "problem": experiment.problem,
        "time": experiment.time,
        "agents": experiment.agents,
        "names": experiment.names,
        "unpredicted": prediction if isinstance(prediction, str) else None,
    }


def _prediction(experiment: Experiment) -> Prediction | str:
    """The prediction, or why there is none."""
    try:
        experiment.require_available("predict")
        return predict(experiment)
    except InputError as error:
        return str(error)


def _laws(prediction: Prediction) -> dict[str, Moments]:
    """By their names in ``msg-analysis predict --json``."""
    steps = "discrete" if prediction.experiment.time == "discrete" else "emulated"
    laws = {"continuous": prediction.continuous_moments, steps: prediction.emulated}
    laws["static"] = prediction.static_moments
    return {name: moments for name, moments in laws.items() if moments is not None}


def _errors(*laws: Moments | None) -> dict[str, Any]:
    nodes = [moments.node_errors.tolist() if moments else [] for moments in laws]
    pairs = zip(*nodes, strict=True) if len(nodes[0]) == len(nodes[1]) else ()  # else not the same agents
    system = relative(*(moments.system_error if moments else None for moments in laws))
    return {"system_error": system, "node_errors": [relative(*pair) for pair in pairs]}


def _rates(prediction: Prediction) -> dict[str, float | None]:
    """Final decay rates of the steps of the run, per unit of time; None: not found, infinite, or no such thing."""
    unit = prediction.experiment.step_length
    rates = dataclasses.asdict(asymptotic_rates(prediction.system))
    return {key: rate / unit if rate is not None and math.isfinite(rate) else None for key, rate in rates.items()}


def _leaders(
    a: Experiment, b: Experiment, found: list[Prediction | str], watch: SearchProgress | None
) -> list[dict[str, Any]]:
    """Leaders of each, and the best set of as many; one without leaders gets as many, and the gain, of the other."""
    sides = []
    for experiment, other, prediction in ((a, b, found[0]), (b, a, found[1])):
        own = experiment.spec.leaders
        pattern = own or other.spec.leaders
        count, gain = (len(pattern.agents), pattern.gain) if pattern else (1, math.inf)
        side: dict[str, Any] = dict.fromkeys(("agents", "gain", "system_error", "best", "note"))
        if own:
            side |= {"agents": list(own.agents), "gain": "inf" if math.isinf(own.gain) else own.gain}
        sides.append(side)
        if isinstance(prediction, str):
            side["note"] = "no prediction"
        elif experiment.agents > MOST_AGENTS or math.comb(experiment.agents, count) > AUTO_SETS:
            side["note"] = f"not searched: use msg-analysis leaders {experiment.source}"
        else:
            try:
                selection = select_leaders(experiment, count, gain=gain, method="exhaustive", top=1, watch=watch)
            except InputError as error:
                side["note"] = str(error)
                continue
            document = selection.to_json()
            best = {key: document["sets"][0][key] for key in ("agents", "system_error")}
            side["best"] = best | {key: document[key] for key in ("gain", "law")}
            side["system_error"] = document["present"]["system_error"] if document["present"] else None
    return sides


_NUMBERS = ("measured", "standard_error", "predicted")


def bag_difference(a: Path, b: Path) -> dict[str, Any]:
    """The document of ``diff`` of two bags. InputError: a bag or its run record cannot be read."""
    runs = [read_bag(path) for path in (a, b)]
    results = [_result(path, run) for path, run in zip((a, b), runs, strict=True)]
    one, other = (run.record for run in runs)
    sides = [_bag_side(*each) for each in zip((a, b), runs, results, strict=True)]
    agents = [agent_errors(result)[0] if "node_errors" in result else [] for result in results]
    pairs = zip(*agents, strict=True) if len(agents[0]) == len(agents[1]) else ()  # else not the same agents
    return {
        "kind": "bags",
        "a": sides[0],
        "b": sides[1],
        "keys": differing(*(flat(record.experiment.to_document()) for record in (one, other))),
        "versions": differing(one.versions, other.versions),
        "states": state_difference(*runs),
        "graphs": graph_difference(*runs),
        "errors": {
            "independent": one.experiment.run.seed != other.experiment.run.seed,
            "system": measured(*(side["system_error"] for side in sides)),
            "agents": [measured(*map(_with_interval, pair)) for pair in pairs],
        },
    }


def _bag_side(path: Path, run: Run, result: dict[str, Any]) -> dict[str, Any]:
    record, completeness = run.record, run.completeness
    tested = tested_error(result, path / RESULT_FILE)
    given = tested is not None and result["system_error"]["standard_error"] is None
    errors = tested or {key: (result.get("system_error") or {}).get(key) for key in _NUMBERS}
    return {
        "bag": str(path),
        "run": str(record.run),
        "experiment": record.experiment.name,
        "seed": record.experiment.run.seed,
        "agents": record.experiment.agents,
        "names": record.experiment.names,
        "steps": record.experiment.steps,
        "simulated_time": record.experiment.run.duration,
        "complete": completeness.complete,
        "completeness": asdict(completeness),
        "prefix": run.prefix,
        "verdict": result.get("verdict"),
        "unpredicted": result.get("unpredicted"),
        "system_error": _with_interval(errors) | {"given_path": given},
    }


def _result(path: Path, run: Run) -> dict[str, Any]:
    """The comparison of a run: as saved beside its bag, or made now; only the reason where there is none."""
    folder = path if path.is_dir() else path.parent
    try:
        document = read_document(folder)
        result_row(folder, document)
        if document.get("run") == str(run.record.run) and "node_errors" in document:
            return document
    except InputError:  # none, or not one
        pass
    try:
        return compare(run).to_json()
    except InputError as error:
        return {"verdict": None, "unpredicted": str(error)}


def _with_interval(error: dict[str, Any]) -> dict[str, Any]:
    """Measured, standard error and prediction, with the 95 % interval."""
    value, deviation = error.get("measured"), error.get("standard_error")
    numbers = {key: error.get(key) for key in _NUMBERS}
    if value is None or deviation is None:
        return numbers | {"low": None, "high": None}
    half = HALF_WIDTH_95 * deviation
    return numbers | {"low": value - half, "high": value + half}


_MOST_PERCENT = 5.0  # larger changes are factors
_RATE_WORDS = {"mean": "of means", "second_moment": "of second moments", "graph": "of graph probabilities"}


def print_bag_difference(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``bag_difference``."""
    a, b = document["a"], document["b"]
    rows = [(key, str(a[key]), str(b[key])) for key in ("bag", "experiment", "seed", "steps")]
    rows += [("states missing", _missing(a), _missing(b)), ("verdict", a["verdict"] or "none", b["verdict"] or "none")]
    print_rows(console, "Runs", ("", "A", "B"), rows)
    _print_keys("Experiment", document["keys"], console)
    _print_keys("Versions", document["versions"], console)
    for line in _states(document):
        console.print(Text(line))
    errors, heads = document["errors"], ("A", "B", "B - A", "in standard errors")
    agents = map(_measured, errors["agents"])
    title, system = "Measured mean-square errors", _measured(errors["system"])
    print_errors(console, title, heads, system, agents, _names(document))
    if not errors["independent"]:
        console.print(Text("Both runs have the same seed: their errors are not independent.", style="dim"))
    _print_unpredicted(document, console)


def _print_unpredicted(document: dict[str, Any], console: Console) -> None:
    for name in "ab":
        if reason := document[name]["unpredicted"]:
            console.print(Text(f"{name.upper()} has no prediction: {reason}"))


def print_experiment_difference(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``experiment_difference``."""
    a, b = document["a"], document["b"]
    console.print(Text(f"A: {a['file']} ({a['name']})\nB: {b['file']} ({b['name']}); changes are from A to B"))
    _print_keys("Keys", document["keys"], console)
    _print_unpredicted(document, console)
    for law, errors in document["predictions"].items():
        title, system = f"Mean-square error in the steady state, {LAW_NAMES[law]}", _relative(errors["system_error"])
        agents = map(_relative, errors["node_errors"])
        print_errors(console, title, ("A", "B", "change"), system, agents, _names(document))
    rows = [[title, *_relative(document["rates"][key])] for key, title in _RATE_WORDS.items()]
    print_rows(console, "Decay rates of the steps of the run", ("", "A", "B", "change"), rows)
    leaders = number_table(console, "Leaders", "", "agents", "gain", "system error")
    for name, key in (("A", "a"), ("B", "b")):
        side, names = document["leaders"][key], document[key]["names"]
        if side["agents"]:
            leaders.add_row(name, *_leader_cells(side, names))
        if side["best"]:
            leaders.add_row(f"best of {name}", *_leader_cells(side["best"], names))
        elif side["note"]:
            leaders.caption = f"{leaders.caption or ''}{name}: {side['note']}. "
    print_table(console, leaders)


def _print_keys(title: str, keys: Sequence[dict[str, Any]], console: Console) -> None:
    if not keys:
        console.print(Text(f"{title}: no difference"))
        return
    table = fact_table(console, f"{title}: {counted(len(keys), 'difference')}")
    for entry in keys:
        values = (entry["a"], entry["b"])
        texts = ["-" if value is None else value if isinstance(value, str) else show(value) for value in values]
        table.add_row(Text(entry["key"]), Text("A: {}\nB: {}".format(*texts)))
    console.print(table)


def _missing(side: dict[str, Any]) -> str:
    count = side["completeness"]
    graphs = f", graphs of {count['missing_modes']} steps" if count["missing_modes"] else ""
    return f"{count['missing']} of {count['expected']}{graphs}"


def _states(document: dict[str, Any]) -> list[str]:
    """What is said of states and graphs."""
    states, graphs = document["states"], document["graphs"]
    if states["compared"] is None:
        return [f"States: not comparable: {states['why']}"]
    lines = []
    first, largest, last, names = states["first"], states["largest"], states["last"], _names(document)
    if states["equal"]:
        lines.append(f"States: equal to the last bit, x(0) to x({states['compared']})")
    elif first is None:
        lines.append(f"States: equal to the last bit up to x({states['compared']}), where both runs have them")
    else:
        named = listed([agent_name(agent, names) for agent in first["agents"]])
        everybody = len(first["agents"]) == document["a"]["agents"]
        agents = "all agents" if everybody else f"agent{'s' * (len(first['agents']) > 1)} {named}"
        agent = agent_text(largest["agent"], names)
        lines += [
            f"States: first difference at step {first['step']} (time {number_text(first['time'])}), {agents}, by "
            f"{number_text(first['difference'])}",
            f"  different: {counted(states['states'], 'state')} in {counted(states['steps'], 'step')} of "
            f"{states['compared'] + 1}",
            f"  largest: {number_text(largest['difference'])} at step {largest['step']}, {agent}, "
            f"number {largest['number']}; at the last common step {last['step'] if last else '-'}: "
            f"{number_text(last['difference'] if last else None)}",
        ]
    lines += [
        f"  {states[key]} states only in {name}" for key, name in (("only_a", "A"), ("only_b", "B")) if states[key]
    ]
    if graphs:
        lines.append(
            f"Graphs: first difference at step {graphs['step']}: {graphs['a']} in A, {graphs['b']} in B; "
            f"different in {counted(graphs['steps'], 'step')}"
        )
    else:
        lines.append("Graphs: equal in all steps that both runs have")
    return lines


def _measured(error: dict[str, Any]) -> list[str]:
    sides = (error["a"] or {}, error["b"] or {})
    texts = [measured_text(side.get("measured"), (side.get("low"), side.get("high"))) for side in sides]
    return [*(text.removesuffix(" (95 %)") for text in texts), number_text(error["difference"], 3), z_text(error["z"])]


def _relative(pair: dict[str, Any]) -> list[str]:
    a, b, change = pair["a"], pair["b"], pair["relative"]
    text = "-" if change is None else "equal"
    if change:
        factor = abs(change) > _MOST_PERCENT
        text = f"{number_text(b / a, 3)} times" if factor else f"{'+' if change > 0 else '-'}{percent(abs(change))}"
    return [number_text(a), number_text(b), text]


def _leader_cells(side: dict[str, Any], names: Sequence[str] | None) -> list[str | Text]:
    agents = Text(listed([agent_name(agent, names) for agent in side["agents"]]))
    gain = side["gain"]
    return [agents, gain if gain == "inf" else number_text(gain), number_text(side["system_error"])]


def _names(document: dict[str, Any]) -> list[str] | None:
    """The names of the agents, where both have the same ones."""
    names: list[str] | None = document["a"]["names"]
    return names if names == document["b"]["names"] else None
