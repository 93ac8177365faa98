# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The experiment and its graphs in words and as SVG drawings; intervals as bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import agent_name, listed, z_text
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.markov_chain import SojournSchedule
from msg_analysis.report.look import LABELLED, places, shorten
from msg_analysis.report.plot_style import NOBODY, Candidates, graph_variable
from msg_analysis.theory.graph_indices import algebraic_connectivity

_LEAST_REACH = 0.02  # relative deviation at the ends of the narrowest scale


def plus_minus(measured: float | None, interval: Sequence[float | None]) -> str:
    """``1.722 ± 0.146``: four digits or more, so that the half-width has two; "–" for None."""
    if measured is None:
        return "–"
    low, high = interval
    half = None if low is None or high is None else (high - low) / 2
    size = abs(measured)
    if size != 0.0 and not 1e-3 <= size < 1e6:
        text = f"{measured:#.4g}" + ("" if half is None else f" ± {half:.2g}")
    else:
        digits = 3 - (math.floor(math.log10(size)) if size else 0)
        if half:
            digits = max(digits, 1 - math.floor(math.log10(half)))
        digits = min(max(digits, 0), 9)
        text = f"{measured:.{digits}f}" + ("" if half is None else f" ± {half:.{digits}f}")
    return text.replace("-", "−")


def interval_bars(estimates: Sequence[Mapping[str, Any]]) -> list[Markup]:
    """A bar per estimate around its prediction, all on one scale; empty where nothing is measured or predicted."""
    ends = [_relative(estimate) for estimate in estimates]
    reach = max((abs(value) for found in ends if found for value in found), default=0.0)
    reach = 1.05 * max(reach, _LEAST_REACH)
    return [_bar(estimate, found, reach) for estimate, found in zip(estimates, ends, strict=True)]


def _relative(estimate: Mapping[str, Any]) -> tuple[float, ...] | None:
    """Measured value and, where known, the ends of its interval, as relative deviations from the prediction."""
    measured, predicted = estimate["measured"], estimate["predicted"]
    if measured is None or predicted is None or predicted <= 0.0:
        return None
    known = [measured, *(end for end in estimate["interval"] if end is not None)]
    found = tuple(value / predicted - 1.0 for value in known)
    return found if all(map(math.isfinite, found)) else None


def _bar(estimate: Mapping[str, Any], found: tuple[float, ...] | None, reach: float) -> Markup:
    if found is None:
        return Markup("")
    places = [50.0 + 50.0 * value / reach for value in found]
    apart, line = False, ""
    if len(places) == 3:
        apart = not found[1] <= 0.0 <= found[2]
        line = f'<i style="left:{places[1]:.1f}%;width:{places[2] - places[1]:.1f}%"></i>'
    words = f"{100 * found[0]:+.2g} % of the prediction"
    if estimate.get("z") is not None:
        words += f"; z = {z_text(estimate['z'])}"
    words = words.replace("-", "−")
    return Markup(
        f'<span class="bar{" apart" if apart else ""}" title="{escape(words)}">{line}'
        f'<b style="left:{places[0]:.1f}%"></b><span class="hidden">{escape(words)}</span></span>'
    )


MOST_GRAPHS = 8  # that are drawn
MOST_MODES = 6  # graphs whose chain is drawn; with more, the report has a table of the rates
MARK = ' class="candidate"'
_SIDE = 200.0
_WEIGHTS = 5  # different line widths


def graph_drawings(experiment: Experiment, candidates: Candidates = NOBODY) -> list[Markup]:
    """The first ``MOST_GRAPHS`` graphs, each agent at the same place in all of them; leaders are squares."""
    found = places(experiment.written_graphs)
    where = np.array([found[agent] for agent in range(experiment.agents)], dtype=float)
    low, high = where.min(axis=0), where.max(axis=0)
    where = (where - (low + high) / 2) * (_SIDE - 44.0) / max(float((high - low).max()), 1e-9)
    where[:, 1] *= -1  # downwards
    where = where + _SIDE / 2
    leaders = set(experiment.spec.leaders.agents) if experiment.spec.leaders else set()
    return [
        _graph(graph, where, graph_variable(mode), leaders, candidates, experiment.names)
        for mode, graph in enumerate(experiment.written_graphs[:MOST_GRAPHS])
    ]


def _graph(
    graph: Graph, where: FloatArray, colour: str, leaders: set[int], candidates: Candidates, names: Sequence[str] | None
) -> Markup:
    radius = 11.0 if graph.agents <= 12 else 8.0 if graph.agents <= LABELLED else 3.0
    links = graph.edges if graph.symmetric else graph.arcs
    parts = [
        f'<svg viewBox="0 0 {_SIDE:g} {_SIDE:g}" role="img" aria-label="{escape(graph.name)}: {len(links)} links" '
        'xmlns="http://www.w3.org/2000/svg">',
        *_links(links, where, colour, radius, directed=not graph.symmetric),
        *_marked_links(candidates.links_of(graph.name), links, where),
    ]
    for agent, (x, y) in enumerate(where, start=1):
        name = agent_name(agent, names)
        kind, shape = "agent", f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"'
        if agent in leaders:
            kind, size = "leader, agent", f'width="{2 * radius:g}" height="{2 * radius:g}"'
            shape = f'<rect x="{x - radius:.1f}" y="{y - radius:.1f}" {size}'
        senders: list[int] = (np.flatnonzero(graph.adjacency[agent - 1]) + 1).tolist()
        named = ", ".join(agent_name(other, names) for other in senders[:20]) or "no agent"
        named += ", …" if len(senders) > 20 else ""
        parts.append(
            f'<g>{shape} fill="var(--page)" stroke="{colour}" stroke-width="1.5"'
            f"{MARK if agent in candidates.agents else ''}/>"
            f"<title>{escape(f'{kind} {name} receives from {named}')}</title>"
        )
        if graph.agents <= LABELLED:
            font = radius * min(1.0, 2.4 / len(name)) if names else radius if agent < 100 else 0.8 * radius
            parts.append(
                f'<text x="{x:.1f}" y="{y:.1f}" font-size="{font:g}" text-anchor="middle" dominant-baseline="central" '
                f'fill="var(--ink)" pointer-events="none">{escape(shorten(name, 8))}</text>'
            )
        parts.append("</g>")
    return Markup("".join([*parts, "</svg>"]))


def _links(
    links: list[tuple[int, int, float]], where: FloatArray, colour: str, radius: float, *, directed: bool
) -> list[str]:
    """One path per line width, since dense graphs have thousands of links."""
    heaviest = max((weight for _, _, weight in links), default=1.0)
    lines: dict[int, list[str]] = {}
    heads: list[str] = []
    for source, target, weight in links:
        a, b = where[source - 1], where[target - 1]
        step = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
        across = np.array([-step[1], step[0]])
        if directed:  # moved aside, so that opposite arcs do not overlap
            a, b = a + 2 * across, b + 2 * across - radius * step
            left, right = b - 6 * step + 3 * across, b - 6 * step - 3 * across
            heads.append(f"M{_at(b)}L{_at(left)}L{_at(right)}Z")
        lines.setdefault(math.ceil(_WEIGHTS * weight / heaviest), []).append(f"M{_at(a)}L{_at(b)}")
    thin = 0.25 if len(links) > 400 else 0.5 if len(links) > 60 else 1.0
    drawn = [
        f'<path d="{"".join(paths)}" fill="none" stroke="{colour}" stroke-opacity=".8" '
        f'stroke-width="{thin * (0.6 + 2.6 * width / _WEIGHTS):.2f}"/>'
        for width, paths in sorted(lines.items())
    ]
    return drawn + ([f'<path d="{"".join(heads)}" fill="{colour}"/>'] if heads else [])


def _marked_links(marked: set[tuple[int, int]], links: list[tuple[int, int, float]], where: FloatArray) -> list[str]:
    """The links that the verdict names, on top of the others."""
    there = {(source, target) for source, target, _ in links}
    return [
        f'<path class="candidate" d="M{_at(where[first - 1])}L{_at(where[second - 1])}" fill="none">'
        f"<title>named by the verdict: {first}-{second}</title></path>"
        for first, second in sorted(marked)
        if {(first, second), (second, first)} & there
    ]


def _at(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def chain_drawing(experiment: Experiment, candidates: Candidates = NOBODY) -> Markup | None:
    """A circle per graph, an arrow per rate; None for one graph, more than ``MOST_MODES``, and with a schedule."""
    modes = len(experiment.graph_list)
    if not 1 < modes <= MOST_MODES or experiment.schedule:
        return None
    chain = experiment.chain
    radius = 46.0
    ring = 105.0 if modes == 2 else 150.0
    angles = [math.pi - 2 * math.pi * mode / modes for mode in range(modes)]
    centres = np.array([(ring * math.cos(angle), -ring * math.sin(angle)) for angle in angles])
    low, high = centres.min(axis=0) - radius - 30, centres.max(axis=0) + radius + 30
    width, height = (high - low).tolist()
    unit = "rate" if chain.time == "continuous" else "probability"
    parts = [
        f'<svg viewBox="{low[0]:.0f} {low[1]:.0f} {width:.0f} {height:.0f}" width="{width:.0f}" role="img" '
        f'aria-label="Markov chain of {modes} graphs" xmlns="http://www.w3.org/2000/svg">'
    ]
    names = [graph.name for graph in experiment.graph_list]
    for i in range(modes):
        for j in range(modes):
            if i != j and chain.matrix[i, j] > 0:
                title = f"{unit} from {names[i]} to {names[j]}: {chain.matrix[i, j]:g}"
                mark = MARK if candidates.jump(names[i], names[j]) else ""
                parts.append(_jump(centres[i], centres[j], radius, f"{chain.matrix[i, j]:.4g}", title, mark))
    for mode, (x, y) in enumerate(centres):
        share = f"{100 * chain.stationary[mode]:.3g} %"
        stay = [f"stays: {chain.matrix[mode, mode]:.3g}"] if chain.time == "discrete" else []
        lines = [shorten(names[mode], 14), share, *stay]
        parts.append(
            f'<g><circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="var(--page)" stroke="{graph_variable(mode)}" '
            f'stroke-width="3"/><title>{escape(names[mode])}</title>'
        )
        for row, line in enumerate(lines):
            size, weight = (13, "600") if row == 0 else (11, "400")
            down = y + 15 * (row - (len(lines) - 1) / 2)
            parts.append(
                f'<text x="{x:.1f}" y="{down:.1f}" font-size="{size}" font-weight="{weight}" fill="var(--ink)" '
                f'text-anchor="middle" dominant-baseline="central">{escape(line)}</text>'
            )
        parts.append("</g>")
    return Markup("".join([*parts, "</svg>"]))


def _jump(a: FloatArray, b: FloatArray, radius: float, label: str, title: str, mark: str) -> str:
    """A bent arrow from one circle to another, on the left of the straight line."""
    step = (b - a) / float(np.hypot(*(b - a)))
    across = np.array([step[1], -step[0]])
    bend = (a + b) / 2 + across * min(0.28 * float(np.hypot(*(b - a))), 60.0)
    start = a + radius * _unit(bend - a)
    end = b + (radius + 2) * _unit(bend - b)
    way = _unit(end - bend)
    side = np.array([-way[1], way[0]])
    left, right = end - 9 * way + 4 * side, end - 9 * way - 4 * side
    middle = 0.25 * start + 0.5 * bend + 0.25 * end
    return (
        f"<g><title>{escape(title)}</title>"
        f'<path d="M{_at(start)}Q{_at(bend)} {_at(end - 8 * way)}" fill="none" stroke="var(--soft)" '
        f'stroke-width="1.5"{mark}/>'
        f'<path d="M{_at(end)}L{_at(left)}L{_at(right)}Z" fill="var(--soft)"/>'
        f'<text x="{middle[0]:.1f}" y="{middle[1]:.1f}" font-size="13" fill="var(--ink)" text-anchor="middle" '
        'stroke="var(--page)" stroke-width="8" paint-order="stroke" dominant-baseline="central">'
        f"{escape(label)}</text></g>"
    )


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.hypot(*vector)), 1e-9))


def explain(experiment: Experiment) -> list[str]:
    """What the agents do, what switches, what is random, and what was run: a short paragraph each."""
    return [_task(experiment), _switching(experiment), _noise(experiment), _run(experiment)]


def graph_facts(experiment: Experiment) -> list[dict[str, Any]]:
    """Of those that are drawn; ``share`` of time and ``held``, mean holding time [units of simulated time], or None."""
    graphs, shares, held = experiment.written_graphs, experiment.switching_law.stationary, experiment.holding_times
    rows = zip(graphs[:MOST_GRAPHS], *([[None], [None]] if experiment.links else [shares, held]), strict=False)
    return [
        {
            "name": graph.name,
            "links": graph.links,
            "directed": not graph.symmetric,
            "connectivity": algebraic_connectivity(graph),
            "share": None if share is None else float(share),
            "held": held,
        }
        for graph, share, held in rows
    ]


def _task(experiment: Experiment) -> str:
    agents, leaders = experiment.agents, experiment.spec.leaders
    if experiment.protocol:
        info = experiment.protocol.info
        kind = "linear" if info.linear else "not linear, so there is no prediction"
        return f"{agents} agents follow the protocol {info.name} of the package {info.package} ({kind})."
    text = f"Each of {agents} agents has a number as its state and moves it towards the states that it receives"
    if leaders is None:
        return (
            f"{text} (consensus). An agent error is the mean square of the distance of a state from the average of all "
            "states; the system error is the sum of the agent errors."
        )
    named = listed([agent_name(agent, experiment.names) for agent in leaders.agents])
    who = f"leader, agent {named}, is" if len(leaders.agents) == 1 else f"leaders, agents {named}, are"
    pull = "held at" if math.isinf(leaders.gain) else f"pulled with gain {leaders.gain:g} to"
    return (
        f"{text}; the {who} {pull} the reference {leaders.reference:g} (tracking). An agent error is the mean square "
        "of the distance of a state from the reference; the system error is the sum of the agent errors."
    )


def _switching(experiment: Experiment) -> str:
    modes = len(experiment.graph_list)
    if modes == 1:
        return f"The graph is always {experiment.graph_list[0].name}."
    if experiment.noise.leaves_out_steps:
        return (
            f"Each agent makes a step with probability {experiment.noise.activation:g}, whatever the others do, or "
            f"keeps its state; the {modes} graphs of the run are those of the agents that make a step. All "
            "predictions are given these graphs."
        )
    if links := experiment.links:
        both = [
            f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            for rates in (links.up, links.down)
            for low, high in [(rates.min(), rates.max())]
        ]
        what = "probabilities" if experiment.time == "discrete" else "rates"
        return (
            f"Each of {len(links)} links switches by itself: it comes up and goes down with the {what} {both[0]} and "
            f"{both[1]}, whatever the others do. All predictions are given the {modes} graphs of the run."
        )
    if isinstance(experiment.schedule, SojournSchedule):
        shapes = ", ".join(f"{name} {erlang.shape}" for name, erlang in (experiment.switching.sojourn or {}).items())
        return (
            f"The graph switches between {modes} graphs, a semi-Markov chain: holding times are Erlang, of the shapes "
            f"{shapes}. All predictions are given the path of the run."
        )
    if schedule := experiment.schedule:
        stretches = f"{len(schedule.starts)} stretches of time" + (", again and again" if schedule.repeat else "")
        return f"The sequence of {modes} graphs is given: {stretches}. All predictions are given this sequence."
    chain = experiment.chain
    first = experiment.switching.initial
    begin = "drawn from the stationary distribution" if first == "stationary" else first
    begin = f"The first graph is {begin}."
    if chain.time == "discrete":
        return f"The graph switches between {modes} graphs: a Markov chain that may jump in every step. {begin}"
    times = [time for time in experiment.holding_times if time is not None]
    held = f"{min(times):.3g}" if max(times) - min(times) < 1e-9 else f"{min(times):.3g} to {max(times):.3g}"
    return (
        f"The graph switches between {modes} graphs: a Markov chain in continuous time, with mean holding time "
        f"{held} [units of simulated time]. {begin}"
    )


def _noise(experiment: Experiment) -> str:
    noise = experiment.noise
    process = noise.process
    size = f"gain {process:g}" if isinstance(process, float | int) else "a gain matrix"
    if isinstance(process, dict):
        size = "a gain that depends on the graph"
    elif isinstance(process, list) and not isinstance(process[0], list):
        size = "a different gain for each agent"
    parts = [f"Process noise with {size} acts on the states"]
    if noise.broadcast:
        parts.append(f"published values have noise of standard deviation {noise.broadcast:g}, equal for all receivers")
    if noise.link:
        parts.append(f"each receiver adds noise of standard deviation {noise.link:g}")
    if noise.loss.any:
        parts.append(_losses(experiment))
    if noise.delay:
        parts.append(f"received values are {noise.delay} steps old")
    return "; ".join(parts) + "."


def _losses(experiment: Experiment) -> str:
    noise, loss = experiment.noise, experiment.noise.loss
    text = f"{100 * loss.default:.3g} % of the messages are lost"
    if special := [probability for *_, probability in (*loss.arcs, *loss.edges)]:
        span = " to ".join(sorted({f"{100 * p:.3g}" for p in (min(special), max(special))}, key=float))
        text += f", and {span} % of those of {len(special)} link{'s' if len(special) > 1 else ''}"
    if noise.burst is not None:
        text += f", on average {noise.burst:.3g} of a link in a row"
    return text + (", and the last received value takes the place of a lost one" if noise.holds else "")


def _run(experiment: Experiment) -> str:
    run = experiment.run
    replicas = "1 replica" if run.replicas == 1 else f"{run.replicas} independent replicas on the same graph path"
    start = {"stationary": "the steady state", "zero": "0"}
    begun = start[run.start] if isinstance(run.start, str) else "given values"
    pace = "Lockstep: all agents use values of the same step."
    if run.pace == "realtime":
        rate = f"{run.speed / experiment.step_length:.3g} steps per second"
        pace = f"Real time: the timer of each agent starts {rate}, with the newest values received."
    return (
        f"The run has {experiment.steps} steps of {experiment.step_length:g} ({run.duration:g} units of simulated "
        f"time) and {replicas}, and starts from {begun}. {pace}"
    )
