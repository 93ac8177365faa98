# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The report of a run as one HTML page."""

from __future__ import annotations

import base64
import datetime
import gzip
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.models import ColumnDataSource, UIElement
from bokeh.resources import Resources
from markupsafe import Markup

from msg_analysis.common.files import write_whole
from msg_analysis.common.text import agent_text, counted, listed, measured_text, p_text, percent, with_names
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.observation import bounded
from msg_analysis.inference.realtime_laws import SUPPORT
from msg_analysis.model.run_record import RunRecord
from msg_analysis.report import drawings, error_plots, plot_style, run_plots
from msg_analysis.report.comparison_text import (
    CORRECTED,
    QUANTILES,
    REAL_TIME_LAWS,
    TIMES,
    agent_errors,
    agent_order,
    any_time_words,
    furthest,
    lost_words,
    power_words,
    sentence,
    timing_facts,
    trust_words,
    verdict_line,
)
from msg_analysis.report.drawings import explain, graph_facts, interval_bars, plus_minus
from msg_analysis.report.error_plots import covariances
from msg_analysis.report.plot_style import Candidates
from msg_analysis.report.run_plots import Event, run_events
from msg_analysis.report.tables import interval_text
from msg_analysis.theory.prediction import LAW_NAMES
from msg_analysis.twin.check import check


@cache
def page_template(name: str) -> jinja2.Template:
    """A template of this folder, which escapes what is put into it, and fails where something is missing."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("msg_analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": _number, "p": lambda p: minus_sign(p_text(p))}
    return environment.get_template(name)


def minus_sign(number: str) -> str:
    """With a minus sign, and a dash where there is no number."""
    return "–" if number == "-" else number.replace("-", "−")


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else minus_sign(f"{value:#.{digits}g}".rstrip("."))


def pack(models: Mapping[str, UIElement]) -> tuple[dict[str, Markup], Markup]:
    """The place of each figure, and what follows once in a page, before its scripts."""
    document = Document()
    shelf = ColumnDataSource(name="figures", tags=list(models.values()))  # no figure is a root: none is drawn at once
    with document.models.freeze():
        document.add_root(shelf)
    places = {
        name: Markup('<div class="figure" data-figure="{}" style="height: {}px"></div>').format(model.id, model.height)
        for name, model in models.items()
    }
    blocks = {"library": _library(), "figures": _packed(serialize_json(document.to_json(deferred=False)).encode())}
    block = Markup('<script type="text/plain" id="{}">{}</script>\n')
    return places, Markup().join(block.format(name, text) for name, text in blocks.items())


@cache
def _library() -> str:
    return _packed(Resources(mode="inline", components=["bokeh"]).js_raw[0].encode())


def _packed(content: bytes) -> str:
    """As gzip in base64; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()


SYMBOLS = {"agrees": "✓", "disagrees": "✗", "late": "!", "incomplete": "?", "unpredicted": "–"}
_SHOWN_SEEDS = 8


def page_title(comparison: Comparison) -> str:
    """The title of the tab, what differs between runs first: verdict, name, seed, date."""
    records = _records(comparison)
    runs = [counted(len(records), "run")] if len(records) > 1 else []
    parts = [records[0].experiment.name, *runs, _seeds(records), _dates(records)[0]]
    return f"{SYMBOLS[comparison.verdict]} {', '.join(parts)}: {comparison.verdict}"


def run_facts(comparison: Comparison, wall_time: float | None) -> list[tuple[str, str]]:
    """Seed, date, duration and pace of the run or the runs; ``wall_time`` [s] if it is known."""
    records = _records(comparison)
    experiment, run, dates = records[0].experiment, records[0].experiment.run, _dates(records)
    seeds, _, numbers = _seeds(records).partition(" ")
    durations = sorted({record.experiment.run.duration for record in records})
    time = " to ".join(f"{each:g}" for each in dict.fromkeys((durations[0], durations[-1])))
    steps = f", {counted(experiment.steps, 'step')} of {experiment.step_length:g}" if len(durations) == 1 else ""
    each = " each" if len(records) > 1 else ""
    external = [agent_text(i + 1, experiment.names) for i in sorted(experiment.external)]
    return [
        (seeds, numbers),
        ("date", " to ".join(dict.fromkeys((dates[0], dates[-1]))) + " UTC"),
        ("duration", f"{time} units of time{steps}{each}" + (f", in {wall_time:.3g} s" if wall_time else "")),
        ("pace", "lockstep" if run.pace == "lockstep" else f"real time, {run.speed:g} units of time per second"),
        *([("external", listed(external))] if external else []),
    ]


def _records(comparison: Comparison) -> list[RunRecord]:
    pool = comparison.pool
    return [member.record for member in pool.members] if pool else [comparison.trajectory.record]


def _seeds(records: Sequence[RunRecord]) -> str:
    seeds = [str(record.experiment.run.seed) for record in records]
    shown = ", ".join(seeds[:_SHOWN_SEEDS]) + (", …" if len(seeds) > _SHOWN_SEEDS else "")
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {shown}"


def _dates(records: Sequence[RunRecord]) -> list[str]:
    """Ascending, to the minute."""
    dates = sorted(record.started for record in records)
    return [date.astimezone(datetime.UTC).strftime("%Y-%m-%d %H:%M") for date in dates]


_OPEN_TABLE = 12  # most agents with which the table of the nodes is open at first
_SMALL_CHAIN = 8  # most graphs whose transitions are listed
_FIRST_LINES, _FIRST_TRAJECTORIES = 5, 8
_NODE_TEST = "error of agent "  # beginning of the names of the tests of the nodes


def write_report(
    comparison: Comparison,
    file: str | Path,
    *,
    restarts: Sequence[str] = (),
    rejected_messages: Sequence[Mapping[str, Any]] = (),
    events: Sequence[Mapping[str, Any]] = (),
    wall_time: float | None = None,
    channel: Mapping[str, Any] | None = None,
) -> Path:
    """Write a comparison as one self-contained HTML page, whole or not at all.

    Parameters
    ----------
    comparison
        of one run or of several
    file
        path of the page; replaced if it exists
    restarts
        what the network reported: a line per process that was restarted
    rejected_messages
        ``node``, ``topic``, ``reason`` and ``count`` per kind of refused message
    events
        ``kind`` ("killed", "back" or "refused"), ``step`` and ``words`` per event
    wall_time
        duration of the run [s]
    channel
        hosts and packets of each pair of them, as in result.json

    Returns
    -------
    Path
        the file

    Raises
    ------
    InputError
        the file cannot be written
    """
    path = Path(file)
    network: dict[str, Any] = {
        "restarts": restarts,
        "rejected_messages": rejected_messages,
        "events": events,
        "channel": channel,
    }
    html = render(comparison, wall_time=wall_time, **network)
    try:
        write_whole(path, html.encode(errors="replace"))  # names of files need not be UTF-8
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error
    return path


def render(
    comparison: Comparison,
    *,
    restarts: Sequence[str] = (),
    rejected_messages: Sequence[Mapping[str, Any]] = (),
    events: Sequence[Mapping[str, Any]] = (),
    wall_time: float | None = None,
    channel: Mapping[str, Any] | None = None,
    host: str | None = None,  # where the report is written and by which command; None: here, and by this one
    command: str | None = None,
) -> str:
    """The report as HTML text; arguments as of ``write_report``."""
    document, trajectory = comparison.to_json(), comparison.trajectory
    experiment = trajectory.record.experiment
    names = [graph.name for graph in experiment.graph_list]
    candidates = Candidates.of(document["causes"])
    happened, more_events = run_events(trajectory, events)
    models, drawn = _models(document, comparison, candidates, happened)
    places, packed = pack(models)
    timing = document["timing"]
    apart = [place + 1 for place in furthest([node["z"] for node in agent_errors(document)[0]], _FIRST_LINES)]
    template = page_template("report.html.j2")
    return template.render(
        named=lambda text: with_names(text, experiment.names),
        document=document,
        title=page_title(comparison),
        run_facts=run_facts(comparison, wall_time),
        symbol=SYMBOLS[document["verdict"]],
        restarts=restarts,
        rejected_messages=rejected_messages,
        channel=channel,
        headline=verdict_line(document),
        power=" ".join(power_words(document)),
        timing_facts=timing_facts(timing) if timing else [],
        lost_words=lost_words(document),
        times=TIMES,
        quantiles=QUANTILES,
        laws=REAL_TIME_LAWS,
        law_bars=interval_bars([document["laws"][law]["system_error"] for law in REAL_TIME_LAWS] if timing else []),
        law_name=LAW_NAMES["emulated" if document["law"] == "synchronous" else document["law"]],
        support=SUPPORT,
        explanation=_explanation(document),
        decided=min(filter(lambda test: test["rejected"], document["tests"]), key=_adjusted, default=None),
        next_step=_next_step(comparison, document),
        sequence=_sequence(comparison, document),
        causes=[with_names(sentence(cause["words"]), experiment.names) for cause in document["causes"]],
        cause_known=bool(document["causes"]) and document["causes"][0]["kind"] != "unknown",
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
        first_agents=_first(_FIRST_LINES, *candidates.involved, *apart),  # whose convergence is drawn at first
        style=plot_style,
        most_lines=error_plots.MOST_LINES,
        most_lanes=run_plots.MOST_LANES,
        drawn=drawn,
        shown=_first(_FIRST_TRAJECTORIES, *candidates.involved, *range(1, experiment.agents + 1)),
        candidates=candidates,
        events=happened,
        more_events=more_events,
        step_length=experiment.step_length,
        room=run_plots.OTHER_REPLICAS,
        explained=explain(experiment),
        drawings=drawings.graph_drawings(experiment, candidates),
        graph_facts=graph_facts(experiment),
        chain=drawings.chain_drawing(experiment, candidates),
        yaml=yaml.safe_dump(experiment.to_document(), sort_keys=False, allow_unicode=True, default_flow_style=None),
        host=host or platform.node() or "unnamed host",
        tests=[
            test | {"name": with_names(test["name"], experiment.names)}
            for test in sorted(document["tests"], key=lambda test: not test["rejected"])
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
    document: dict[str, Any], comparison: Comparison, candidates: Candidates, events: Sequence[Event]
) -> tuple[dict[str, UIElement], dict[str, int]]:
    """The figures that exist, by name, and what of the run is in those of the trajectories."""
    trajectory = comparison.trajectory
    experiment, steps = trajectory.record.experiment, max(document["steps"], 0)
    covariance, ratios = document["covariance"], document["innovations"]["ratios"]
    predicted, nodes, names = document["system_error"]["predicted"], agent_errors(document)[0], experiment.names
    drawn_nodes = ((document.get("given_path") or {}).get("node_errors") or []) or nodes
    measured, expected, z = (
        None if covariance[key] is None else np.array(covariance[key], dtype=float)
        for key in ("measured", "predicted", "z")
    )
    models: dict[str, UIElement | None] = {
        "nodes": error_plots.node_errors(drawn_nodes, document["level"], candidates, names),
        **covariances(measured, expected, z, candidates, names),
    }
    if len(comparison.running["time"]) > 1:
        models["running"] = error_plots.convergence(comparison.running, predicted)
    seen = comparison.any_time
    if seen and seen.time is not None and seen.log_curve is not None and np.isfinite(seen.log_curve).all():
        models["evidence"] = error_plots.evidence(seen.time, seen.log_curve, seen.threshold, seen.crossed)
    figures, drawn = run_plots.trajectory_plots(trajectory, predicted, events)
    models |= figures
    known = trajectory.modes[:steps]
    if len(known):
        graphs = [graph.name for graph in experiment.graph_list]
        if not experiment.schedule:
            models["occupancy"] = run_plots.occupancy(known, graphs, experiment.switching_law.stationary)
        if not document["unpredicted"]:
            reference = None if experiment.problem == "consensus" else experiment.reference
            states = bounded(trajectory.values[:steps])
            models["agents"] = error_plots.agent_convergence(states, reference, experiment.step_length, nodes)
    if ratios is not None and any(ratio is not None for ratio in ratios):
        sizes, samples = np.array(ratios, dtype=float), document["innovations"]["samples"]  # None: nan
        models["innovations"] = error_plots.innovation_sizes(sizes, samples, candidates, names)
    if document["timing"]:
        models["lateness"] = error_plots.histogram(document["timing"], "lateness_ms")
        models["staleness"] = error_plots.histogram(document["timing"], "staleness_ms")
    return {name: model for name, model in models.items() if model is not None}, drawn


def _first(most: int, *agents: int) -> list[int]:
    return sorted(list(dict.fromkeys(agents))[:most])


def _explanation(document: dict[str, Any]) -> str:
    tests, completeness, level = document["tests"], document["completeness"], document["level"]
    if document["verdict"] == "incomplete":
        lost = [
            f"{completeness['missing']} of {completeness['expected']} states" if completeness["missing"] else "",
            f"the graph of {completeness['missing_modes']} steps" if completeness["missing_modes"] else "",
        ]
        numbers = f"The numbers below are those of the first {document['steps']} steps, up to the first gap."
        if document["system_error"]["measured"] is None:
            numbers = "The first gap is too early to compute errors."
        return f"Missing: {' and '.join(filter(None, lost))}. {numbers}"
    if document["unpredicted"]:
        results = [f"{test['name']}: {'rejected' if test['rejected'] else 'ok'}" for test in tests]
        cut = f" Errors are measured from step {document['transient']} on." if document["transient"] else ""
        sampled = document.get("sampled")
        interval = f" Sampled instead: {interval_text(sampled['interval'])} (95 %)." if sampled else ""
        return f"No prediction: {document['unpredicted']}.{interval} Tests: {', '.join(results) or 'none'}.{cut}"
    chance = f"A correct run fails a test with probability at most {percent(level)}."
    rejected = [test for test in tests if test["rejected"]]
    if not rejected:
        return f"All {len(tests)} tests are ok. {chance}"
    shown = [f"{test['name']} (p = {minus_sign(p_text(test['p_adjusted']))})" for test in rejected[:6]]
    named = with_names(", ".join(shown), document["names"])
    more = f" and {len(rejected) - 6} more" if len(rejected) > 6 else ""
    return f"Rejected: {len(rejected)} of {len(tests)} tests: {named}{more}. {chance}"


def _adjusted(test: dict[str, Any]) -> float:
    return float(test["p_adjusted"])


def _sequence(comparison: Comparison, document: dict[str, Any]) -> str:
    """Whether the errors in the plot of the agents are corrected for the run's graph sequence, and else what it was."""
    experiment, given = comparison.trajectory.record.experiment, document.get("given_path")
    if given and given["node_errors"]:
        return f"Errors of the agents {CORRECTED}."
    modes = comparison.trajectory.modes[: max(document["steps"], 0)]
    if experiment.schedule:
        return "" if document["unpredicted"] else "Errors are expected given this run's graph sequence."
    if document["unpredicted"] or len(experiment.graph_list) == 1 or not len(modes):
        return ""
    shares = np.bincount(modes[modes >= 0], minlength=len(experiment.graph_list)) / len(modes)
    mode = int(np.abs(shares - experiment.switching_law.stationary).argmax())
    words = f"Not {CORRECTED}: {experiment.graph_list[mode].name} was active in {percent(shares[mode])} of the steps, "
    words += f"{percent(experiment.switching_law.stationary[mode])} on average, which moves all errors together."
    if given:
        error = given["system_error"]
        words += f" The system error {CORRECTED} is {measured_text(error['measured'], error['interval'])}."
    return words


MOST_CHECKED = 2e7  # numbers of a run that is checked for its report


def _next_step(comparison: Comparison, document: dict[str, Any]) -> str | None:
    """Of one run that disagrees: whether it is that of its record to the last bit, which `check` says."""
    run = comparison.trajectory
    if document["verdict"] != "disagrees" or comparison.pool or run.states.size > MOST_CHECKED:
        return None
    try:
        difference = check(run).difference
    except NotAvailableError:
        return None
    if difference is None:
        return (
            "Next: `msg-agents check` finds no difference: to the last bit, every state is what the file and the seed "
            "give, so the agents did what the file says. One correct run in a hundred disagrees by chance: run again "
            "with another seed."
        )
    return f"Next: `msg-agents check` finds the first difference to what the file and the seed give: {difference}."


def _node_tests(document: dict[str, Any]) -> dict[str, Any] | None:
    """The tests of all nodes as one row; None where there are none."""
    tests = [test for test in document["tests"] if test["name"].startswith(_NODE_TEST)]
    if not tests:
        return None
    smallest = min(tests, key=lambda test: float(test["p"]))
    return {"count": len(tests), "rejected": sum(test["rejected"] for test in tests), "smallest": smallest}
