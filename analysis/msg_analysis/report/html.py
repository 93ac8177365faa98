"""The report: one HTML file that needs nothing else, not even a network."""

from __future__ import annotations

import base64
import datetime
import os
import shlex
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.inference.compare import Comparison
from msg_analysis.model.trajectory import Trajectory
from msg_analysis.report import figures
from msg_analysis.report.text import LAWS, QUANTILES, SUPPORT, TIMES, timing_facts, verdict_line
from msg_analysis.report.verdict_text import order_statements, sentence

_HEADLINES = {
    "agrees": "The run agrees with the prediction.",
    "disagrees": "The run disagrees with the prediction.",
    "incomplete": "No verdict: the data are incomplete.",
    "unpredicted": "No verdict: there is no prediction.",
}
_OPEN_TABLE = 12  # agents up to which the table of the nodes is open from the start
_SMALL_CHAIN = 8  # graphs up to which all transitions are listed
_NODE_TEST = "error of agent "  # how the tests of the nodes begin


def write_report(
    comparison: Comparison,
    trajectory: Trajectory,
    path: str | Path,
    *,
    restarts: Sequence[str] = (),
    strangers: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Write the report of a comparison, whole or not at all.

    Parameters
    ----------
    comparison
        the result
    trajectory
        what was compared
    path
        of the HTML file; replaced where it exists
    restarts, strangers
        of the network, see ``render``

    Raises
    ------
    InputError
        the file cannot be written
    """
    path = Path(path)
    html = render(comparison, trajectory, restarts=restarts, strangers=strangers)
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.absolute().parent, prefix=f".{path.name}.", delete=False
        ) as stream:
            temporary = Path(stream.name)
            stream.write(html)
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): choose another place") from error


def render(
    comparison: Comparison,
    trajectory: Trajectory,
    *,
    restarts: Sequence[str] = (),
    strangers: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The report as HTML text.

    Parameters
    ----------
    comparison
        the result
    trajectory
        what was compared
    restarts
        Sequence[str] processes that were started again during the run, a line each
    strangers
        Sequence[Mapping[str, Any]] messages that the nodes refused: ``node``, ``topic``, ``reason``, ``count``
    """
    document = comparison.to_json()
    experiment = trajectory.record.experiment
    covariance = document["covariance"]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("msg_analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": _number, "p": _p_value, "z": _distance}
    known = trajectory.modes[: max(document["steps"], 0)]
    chain = experiment.chain
    names = [graph.name for graph in experiment.graph_list]
    pictures = {
        "graphs": figures.graphs(experiment),
        "nodes": figures.node_errors(document["node_errors"], document["level"]),
        "covariance": figures.covariances(_matrix(covariance["measured"]), _matrix(covariance["predicted"])),
    }
    if len(known):
        pictures["modes"] = figures.active_graph(known, names, chain.stationary, experiment.step_length)
    if len(comparison.running["time"]) > 1:
        predicted = document["system_error"]["predicted"]
        pictures["running"] = figures.running_estimate(comparison.running, predicted)
    timing = document["timing"]
    if timing:
        pictures["lateness"] = figures.lateness(timing)
    return environment.get_template("report.html.j2").render(
        document=document,
        restarts=restarts,
        strangers=strangers,
        headline=verdict_line(_HEADLINES[document["verdict"]], document),
        timing_facts=timing_facts(timing) if timing else [],
        times=TIMES,
        quantiles=QUANTILES,
        laws=LAWS,
        support=SUPPORT,
        explanation=_explanation(document),
        blame=[sentence(cause["words"]) for cause in document["blame"]],
        order=_order(document),
        experiment=experiment,
        versions=trajectory.record.versions,
        pictures={name: _data_uri(svg) for name, svg in pictures.items()},
        tests=[test for test in document["tests"] if not test["name"].startswith(_NODE_TEST)],
        node_tests=_node_tests(document),
        nodes_open=experiment.agents <= _OPEN_TABLE,
        names=names,
        transitions=document["switching"]["counts"] is not None and 1 < len(names) <= _SMALL_CHAIN,
        drawn=min(len(names), 8),
        command=shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        written=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def _explanation(document: dict[str, Any]) -> str:
    """The verdict in a sentence or two."""
    tests, completeness, level = document["tests"], document["completeness"], document["level"]
    if document["verdict"] == "incomplete":
        lost = [
            f"{completeness['missing']} of {completeness['expected']} states" if completeness["missing"] else "",
            f"the graph of {completeness['missing_modes']} steps" if completeness["missing_modes"] else "",
        ]
        numbers = (
            f"The numbers below are those of the first {document['steps']} steps, up to the first gap."
            if document["system_error"]["measured"] is not None
            else "Too little came before the first gap for any number."
        )
        return f"Missing: {' and '.join(filter(None, lost))}. {numbers}"
    if document["unpredicted"]:
        rejected = [test["name"] for test in tests if test["rejected"]]
        tested = " and ".join(test["name"] for test in tests) or "nothing"
        outcome = f"{' and '.join(rejected)}: rejected." if rejected else f"Tested, and not rejected: {tested}."
        cut = f" Errors are measured from step {document['transient']} on." if document["transient"] else ""
        return f"Unpredicted: {document['unpredicted']}. {outcome}{cut}"
    chance = f"a run that follows the predicted law would be called a disagreement with a chance of {level:.2g}"
    rejected = [test for test in tests if test["rejected"]]
    if not rejected:
        return f"None of {len(tests)} tests rejects the predicted law ({chance}, all tests together)."
    named = ", ".join(f"{test['name']} (p {_p_value(test['p_adjusted'], '= ')})" for test in rejected[:6])
    more = f" and {len(rejected) - 6} more" if len(rejected) > 6 else ""
    verb = "rejects" if len(rejected) == 1 else "reject"
    return f"{len(rejected)} of {len(tests)} tests {verb} the predicted law: {named}{more}; {chance}."


def _order(document: dict[str, Any]) -> list[str]:
    """Which agents are more certain than which, in sentences."""
    if document["order"] is None:
        return []
    names = [f"agent {i}" for i in range(1, len(document["node_errors"]) + 1)]
    return order_statements(document["order"], names, "is more certain than")


def _node_tests(document: dict[str, Any]) -> dict[str, Any] | None:
    """The tests of all nodes in one line."""
    tests = [test for test in document["tests"] if test["name"].startswith(_NODE_TEST)]
    if not tests:
        return None
    smallest = min(tests, key=lambda test: float(test["p"]))
    return {"count": len(tests), "rejected": sum(test["rejected"] for test in tests), "smallest": smallest}


def _number(value: float | None, digits: int = 4) -> str:
    if value is None:
        return "–"
    return f"{value:#.{digits}g}".rstrip(".").replace("-", "−")


def _distance(z: float | None) -> str:
    """In standard errors."""
    return "–" if z is None else f"{z:+.2f}".replace("-", "−")


def _p_value(p: float | None, equals: str = "") -> str:
    if p is None:
        return "not tested"
    return "< 0.0001" if p < 1e-4 else f"{equals}{p:.{4 if p < 0.01 else 3}f}"


def _matrix(rows: list[list[float]] | None) -> Any:
    return None if rows is None else np.array(rows, dtype=float)


def _data_uri(svg: str) -> str:
    """Of a picture: inside an image, the names within one SVG cannot meddle with those of another."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
