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

"""The HTML report: one file that loads nothing else."""

from __future__ import annotations

import datetime
import platform
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bokeh.models import UIElement

from msg_analysis.common.files import write_whole
from msg_analysis.common.text.agent_names import with_names
from msg_analysis.common.text.number_words import p_text
from msg_analysis.errors import InputError
from msg_analysis.inference.observed.observation import bounded
from msg_analysis.inference.realtime.laws import SUPPORT
from msg_analysis.inference.verdict.comparison import Comparison
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.documents.comparison_words import (
    QUANTILES,
    REAL_TIME_LAWS,
    TIMES,
    agent_errors,
    agent_order,
    any_time_words,
    furthest,
    sentence,
    timing_facts,
    trust_words,
    unheard_words,
    verdict_line,
)
from msg_analysis.report.documents.explanation import explain, graph_facts
from msg_analysis.report.html import network_drawings, run_heading
from msg_analysis.report.html.interval_bars import interval_bars, plus_minus
from msg_analysis.report.html.packed_figures import pack
from msg_analysis.report.html.page_templates import page_template
from msg_analysis.report.html.plots import colours, error_plots, switching_plots, trajectory_plots
from msg_analysis.report.html.plots.accused import Accused
from msg_analysis.report.html.plots.covariance_plots import covariances
from msg_analysis.report.html.plots.run_events import Event, run_events
from msg_analysis.theory.prediction import LAW_NAMES

_OPEN_TABLE = 12  # most agents with which the table of the nodes is open at first
_SMALL_CHAIN = 8  # most graphs whose transitions are listed
_FIRST_LINES, _FIRST_TRAJECTORIES = 5, 8
_NODE_TEST = "error of agent "  # beginning of the names of the tests of the nodes


def write_report(
    comparison: Comparison,
    trajectory: Trajectory,
    path: str | Path,
    *,
    restarts: Sequence[str] = (),
    strangers: Sequence[Mapping[str, Any]] = (),
    events: Sequence[Mapping[str, Any]] = (),
    wall_time: float | None = None,
    channel: Mapping[str, Any] | None = None,
) -> None:
    """Write the report of a comparison, whole or not at all; InputError if that fails. Arguments as in ``render``."""
    path = Path(path)
    html = render(
        comparison,
        trajectory,
        restarts=restarts,
        strangers=strangers,
        events=events,
        wall_time=wall_time,
        channel=channel,
    )
    try:
        write_whole(path, html.encode())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error


def render(
    comparison: Comparison,
    trajectory: Trajectory,
    *,
    restarts: Sequence[str] = (),  # one line per process that was restarted
    strangers: Sequence[Mapping[str, Any]] = (),  # refused messages: node, topic, reason, count
    events: Sequence[Mapping[str, Any]] = (),  # of processes and refused messages: kind, step, node, words
    wall_time: float | None = None,  # [s] that the run took, if known
    channel: Mapping[str, Any] | None = None,  # hosts, and packets of each pair of them, as in result.json
    host: str | None = None,  # where the report is written and by which command; None: here, and by this one
    command: str | None = None,
) -> str:
    """The report as HTML text."""
    document = comparison.to_json()
    experiment = trajectory.record.experiment
    filters: dict[str, Callable[..., Any]] = {"number": _number, "p": _p, "named": _namer(experiment)}
    names = [graph.name for graph in experiment.graph_list]
    accused = Accused.of(document["blame"])
    happened, more_events = run_events(trajectory, events)
    models, drawn = _models(document, comparison, trajectory, accused, happened)
    places, packed = pack(models)
    timing = document["timing"]
    return page_template("report.html.j2", filters).render(
        document=document,
        title=run_heading.page_title(comparison),
        run_facts=run_heading.run_facts(comparison, wall_time),
        symbol=run_heading.SYMBOLS[document["verdict"]],
        restarts=restarts,
        strangers=strangers,
        channel=channel,
        headline=verdict_line(document),
        timing_facts=timing_facts(timing) if timing else [],
        unheard_words=unheard_words(document),
        times=TIMES,
        quantiles=QUANTILES,
        laws=REAL_TIME_LAWS,
        law_bars=interval_bars([document["laws"][law]["system_error"] for law in REAL_TIME_LAWS] if timing else []),
        law_name=LAW_NAMES["emulated" if document["law"] == "synchronous" else document["law"]],
        support=SUPPORT,
        explanation=_explanation(document),
        blame=[with_names(sentence(cause["words"]), experiment.names) for cause in document["blame"]],
        cause_known=bool(document["blame"]) and document["blame"][0]["kind"] != "unknown",
        plus_minus=plus_minus,
        interval_bars=interval_bars,
        heat_maps=[name for name in models if name.startswith("covariance_")],
        order=agent_order(document),
        any_time=" ".join(any_time_words(document)),
        trust=" ".join(trust_words(document)),
        agents=agent_errors(document),
        experiment=experiment,
        versions=trajectory.record.versions,
        plots=places,
        packed=packed,
        first_agents=_first_agents(document, accused.involved),
        line_colours=colours.LINES,
        graph_colours=colours.GRAPHS,
        dark=colours.DARK,
        most_lines=error_plots.MOST_LINES,
        drawn=drawn,
        shown=_shown_agents(experiment.agents, accused.involved),
        accused=accused,
        events=happened,
        more_events=more_events,
        step_length=experiment.step_length,
        room=trajectory_plots.OTHER_REPLICAS,
        explained=explain(experiment),
        drawings=network_drawings.graph_drawings(experiment, accused),
        graph_facts=graph_facts(experiment),
        chain=network_drawings.chain_drawing(experiment, accused),
        yaml=yaml.safe_dump(experiment.to_document(), sort_keys=False, allow_unicode=True, default_flow_style=None),
        host=host or platform.node() or "unnamed host",
        tests=[
            test | {"name": with_names(test["name"], experiment.names)}
            for test in document["tests"]
            if not test["name"].startswith(_NODE_TEST)
        ],
        agent_names=experiment.names,
        node_tests=_node_tests(document),
        nodes_open=experiment.agents <= _OPEN_TABLE,
        names=names,
        transitions=document["switching"]["counts"] is not None and 1 < len(names) <= _SMALL_CHAIN,
        command=command or shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        written=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def _models(
    document: dict[str, Any],
    comparison: Comparison,
    trajectory: Trajectory,
    accused: Accused,
    events: Sequence[Event],
) -> tuple[dict[str, UIElement], trajectory_plots.Drawn]:
    """The figures that exist, by name, and what of the run is in those of the trajectories."""
    experiment, steps = trajectory.record.experiment, max(document["steps"], 0)
    covariance, ratios = document["covariance"], document["innovations"]["ratios"]
    predicted = document["system_error"]["predicted"]
    models: dict[str, UIElement | None] = {
        "nodes": error_plots.node_errors(agent_errors(document)[0], document["level"], accused, experiment.names),
        **covariances(
            _matrix(covariance["measured"]),
            _matrix(covariance["predicted"]),
            _matrix(covariance["z"]),
            accused,
            experiment.names,
        ),
    }
    if len(comparison.running["time"]) > 1:
        models["running"] = error_plots.convergence(comparison.running, predicted)
    seen = comparison.any_time
    if seen and seen.time is not None and seen.log_curve is not None and np.isfinite(seen.log_curve).all():
        models["evidence"] = error_plots.evidence(seen.time, seen.log_curve, seen.threshold, seen.crossed)
    figures, drawn = trajectory_plots.trajectory_plots(trajectory, predicted, events)
    models |= figures
    known = trajectory.modes[:steps]
    if len(known):
        names = [graph.name for graph in experiment.graph_list]
        models["occupancy"] = switching_plots.occupancy(known, names, experiment.chain.stationary)
        if not document["unpredicted"]:
            reference = None if experiment.problem == "consensus" else experiment.reference
            states = bounded(trajectory.values[:steps])
            models["agents"] = error_plots.agent_convergence(
                states, reference, experiment.step_length, agent_errors(document)[0]
            )
    if ratios is not None and any(ratio is not None for ratio in ratios):
        sizes = np.array(ratios, dtype=float)  # None: nan
        models["innovations"] = error_plots.innovation_sizes(
            sizes, document["innovations"]["samples"], accused, experiment.names
        )
    if document["timing"]:
        models["lateness"] = error_plots.lateness(document["timing"])
        models["staleness"] = error_plots.staleness(document["timing"])
    return {name: model for name, model in models.items() if model is not None}, drawn


def _shown_agents(agents: int, accused: Sequence[int]) -> list[int]:
    """The agents (from 1) whose trajectories are drawn at first: the accused, and the first ones."""
    others = [agent for agent in range(1, agents + 1) if agent not in accused]
    return sorted([*accused[:_FIRST_TRAJECTORIES], *others[: max(_FIRST_TRAJECTORIES - len(accused), 0)]])


def _first_agents(document: dict[str, Any], accused: Sequence[int]) -> list[int]:
    """The agents (from 1) whose convergence is drawn at first: the accused, then those with the largest abs(z)."""
    known = [agent + 1 for agent in furthest([node["z"] for node in agent_errors(document)[0]], _FIRST_LINES)]
    return sorted(list(dict.fromkeys([*accused, *known]))[:_FIRST_LINES])


def _explanation(document: dict[str, Any]) -> str:
    """The verdict in a few sentences."""
    tests, completeness, level = document["tests"], document["completeness"], document["level"]
    if document["verdict"] == "incomplete":
        lost = [
            f"{completeness['missing']} of {completeness['expected']} states" if completeness["missing"] else "",
            f"the graph of {completeness['missing_modes']} steps" if completeness["missing_modes"] else "",
        ]
        numbers = (
            f"The numbers below are those of the first {document['steps']} steps, up to the first gap."
            if document["system_error"]["measured"] is not None
            else "The first gap is too early to compute errors."
        )
        return f"Missing: {' and '.join(filter(None, lost))}. {numbers}"
    if document["unpredicted"]:
        results = [f"{test['name']}: {'rejected' if test['rejected'] else 'passed'}" for test in tests]
        cut = f" Errors are measured from step {document['transient']} on." if document["transient"] else ""
        return f"No prediction: {document['unpredicted']}. Tests: {', '.join(results) or 'none'}.{cut}"
    chance = f"If the run follows the predicted law, the probability of a rejected test is at most {level:.2g}."
    rejected = [test for test in tests if test["rejected"]]
    if not rejected:
        return f"All {len(tests)} tests passed. {chance}"
    names = document["names"]
    named = ", ".join(f"{with_names(test['name'], names)} (p = {_p(test['p_adjusted'])})" for test in rejected[:6])
    more = f" and {len(rejected) - 6} more" if len(rejected) > 6 else ""
    return f"Rejected: {len(rejected)} of {len(tests)} tests: {named}{more}. {chance}"


def _node_tests(document: dict[str, Any]) -> dict[str, Any] | None:
    """The tests of all nodes as one row; None where there are none."""
    tests = [test for test in document["tests"] if test["name"].startswith(_NODE_TEST)]
    if not tests:
        return None
    smallest = min(tests, key=lambda test: float(test["p"]))
    return {"count": len(tests), "rejected": sum(test["rejected"] for test in tests), "smallest": smallest}


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else _typeset(f"{value:#.{digits}g}".rstrip("."))


def _namer(experiment: ValidExperiment) -> Callable[[str], str]:
    return lambda text: with_names(text, experiment.names)


def _p(p: float | None) -> str:
    return _typeset(p_text(p))


def _typeset(number: str) -> str:
    """With a dash where there is no number, and a minus sign."""
    return "–" if number == "-" else number.replace("-", "−")


def _matrix(rows: list[list[float]] | None) -> Any:
    return None if rows is None else np.array(rows, dtype=float)
