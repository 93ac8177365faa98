# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a comparison says, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from msg_analysis.common.text import agent_name, agent_text, listed, number_text, percent, with_names
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.graph_indices import algebraic_connectivity
from msg_analysis.theory.prediction import LAW_NAMES


def explain(experiment: Experiment) -> list[str]:
    """What the agents do, what switches, what is random, and what was run: a short paragraph each."""
    return [_task(experiment), _switching(experiment), _noise(experiment), _run(experiment)]


def graph_facts(experiment: Experiment) -> list[dict[str, Any]]:
    """Of every graph: ``name``, ``links``, ``directed``, ``connectivity``, ``share`` (predicted, of time), ``held``.

    ``held`` is the mean holding time [units of simulated time]; None for a graph that is never left.
    """
    rows = zip(experiment.graph_list, experiment.chain.stationary, experiment.chain.holding_times, strict=True)
    return [
        {
            "name": graph.name,
            "links": len(graph.edges if graph.symmetric else graph.arcs),
            "directed": not graph.symmetric,
            "connectivity": algebraic_connectivity(graph),
            "share": float(share),
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
    modes, chain = len(experiment.graph_list), experiment.chain
    if modes == 1:
        return f"The graph is always {experiment.graph_list[0].name}."
    first = experiment.switching.initial
    begin = (
        "The first graph is drawn from the stationary distribution."
        if first == "stationary"
        else f"The first graph is {first}."
    )
    if chain.time == "discrete":
        return f"The graph switches between {modes} graphs: a Markov chain that may jump in every step. {begin}"
    times = [time for time in experiment.chain.holding_times if time is not None]
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
    return text + (", and the last value that was heard takes the place of a lost one" if noise.holds else "")


def _run(experiment: Experiment) -> str:
    run = experiment.run
    replicas = "1 replica" if run.replicas == 1 else f"{run.replicas} independent replicas on the same graph path"
    start = {"stationary": "the steady state", "zero": "0"}
    begun = start[run.start] if isinstance(run.start, str) else "given values"
    if run.pace == "realtime":
        pace = (
            f"Real time: the timer of each agent starts {run.speed / experiment.step_length:.3g} steps per second, "
            "with the newest values received."
        )
    else:
        pace = "Lockstep: all agents use values of the same step."
    return (
        f"The run has {experiment.steps} steps of {experiment.step_length:g} ({run.duration:g} units of simulated "
        f"time) and {replicas}, and starts from {begun}. {pace}"
    )


VERDICTS = {
    "agrees": "The run agrees with the prediction.",
    "disagrees": "The run disagrees with the prediction.",
    "incomplete": "No verdict: the data are incomplete.",
    "unpredicted": "No verdict: there is no prediction. No test is rejected.",
}
TIMES = {
    "lateness_ms": "lateness [ms]",
    "jitter_ms": "error of the period [ms]",
    "staleness_ms": "age of values used [ms]",
    "staleness_steps": "age of values used [steps]",
}
QUANTILES = {"p50": "median", "p95": "95 %", "p99": "99 %", "max": "largest"}
REAL_TIME_LAWS = {key: LAW_NAMES[key] for key in ("pattern", "sequential", "continuous")}


def verdict_line(document: dict[str, Any]) -> str:
    """The verdict on one run or several; in real time with missed deadlines, which are not a disagreement."""
    verdict = VERDICTS[document["verdict"]]
    if document.get("bags"):
        verdict = verdict.replace("The run agrees", "The runs agree").replace("The run disagrees", "The runs disagree")
    deadlines = (document.get("timing") or {}).get("deadlines")
    if not deadlines or not deadlines["missed"]:
        return verdict
    return f"{verdict.removesuffix('.')}; {percent(deadlines['share'])} of the deadlines were missed."


def gaps(count: dict[str, Any]) -> list[str]:
    """Where the gaps of a log are, and what was refused, of ``completeness`` of a comparison; empty for a whole log."""
    lines = []
    if count["missing"]:
        first, last = count.get("stretch") or (None, None)
        if first is None:
            lines.append("No step has the states of all agents.")
        elif first == 0:
            lines.append(f"All steps up to step {last} are complete.")
        else:
            lines.append(
                f"The longest part without gaps is steps {first} to {last}; errors are computed only from step 0 on."
            )
    if count.get("refused"):
        reasons = ", ".join(f"{number} x {reason}" for reason, number in count["refused"].items())
        lines.append(f"Refused: {reasons}")
    return lines


def timing_facts(timing: dict[str, Any]) -> list[tuple[str, str]]:
    """Counts of a run in real time, ``timing`` of a comparison: what was counted, and the numbers."""
    deadlines, uses, graphs = timing["deadlines"], timing["ideal_uses"], timing["outdated_graph"]
    facts = [
        ("period", f"{number_text(timing['period_ms'])} ms"),
        ("deadlines missed", f"{deadlines['missed']} of {deadlines['steps']} ({percent(deadlines['share'])})"),
        ("values used as with ideal timers", f"{uses['ideal']} of {uses['uses']} ({percent(uses['share'])})"),
        ("steps with an outdated graph", f"{graphs['steps']} of {deadlines['steps']} ({percent(graphs['share'])})"),
    ]
    if timing["never_heard"]:
        facts.append(("uses of neighbours before their first message", str(timing["never_heard"])))
    unheard = timing.get("unheard")  # results of older versions have none
    if unheard:
        numbers = f"{unheard['unheard']} of {unheard['messages']} ({percent(unheard['share'])})"
        facts.append(
            ("messages not heard in time", f"{numbers}; lost by the experiment: {percent(unheard['expected'])}")
        )
    return facts


def unheard_words(document: dict[str, Any]) -> list[str]:
    """That messages between agents were lost or late, in a sentence; empty where the experiment says so."""
    words = ((document.get("timing") or {}).get("unheard") or {}).get("words")
    return [with_names(sentence(words), document.get("names"))] if words else []


def sentence(words: str) -> str:
    """The words with a capital letter and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def agent_errors(document: dict[str, Any]) -> tuple[list[dict[str, Any]], bool]:
    """The agent errors, and whether they are corrected for the path of the graphs.

    They are where only these have intervals: in runs that are too short for intervals over all paths.
    """
    given = (document.get("given_path") or {}).get("node_errors") or []
    if document["system_error"].get("standard_error") is None and given:
        return given, True
    return document["node_errors"] or [], False


def any_time_words(document: dict[str, Any]) -> list[str]:
    """The evidence that may be looked at any time, in sentences; empty where there is none."""
    seen = document.get("any_time")
    if not seen:
        return []
    evidence = seen["evidence"]
    shown = number_text(evidence) if evidence is not None else "more than 1e300"
    line = (
        f"Evidence against the prediction, valid however often one looks: {shown} (disagrees at {seen['threshold']:g})"
    )
    if not seen["disagrees"]:
        return [f"{line}."]
    when = f", passed at time {number_text(seen['crossed_at'])}" if seen["crossed_at"] is not None else ""
    strongest = f"; the strongest is on {seen['questions'][0]['about']}" if seen["questions"] else ""
    return [with_names(f"{line}{when}{strongest}.", document.get("names"))]


def trust_words(document: dict[str, Any]) -> list[str]:
    """Which errors to trust, where that is not obvious: with heavy tails, and in runs with few sojourns."""
    trust = document.get("trust")
    return [trust["words"]] if trust and trust["reason"] in ("heavy_tails", "few_sojourns") else []


def agent_order(document: dict[str, Any]) -> list[str]:
    """Which agents are more certain than which, in sentences; empty where that is not known."""
    if not document.get("order"):
        return []
    names = [agent_text(i, document.get("names")) for i in range(1, len(document["node_errors"]) + 1)]
    return order_statements(document["order"], names, "is more certain than")


def order_statements(order: dict[str, Any], names: Sequence[str], relation: str, most: int = 12) -> list[str]:
    """Which of ``names`` differ, in sentences with the ``relation`` of the better one; ``most`` pairs one by one."""

    def named(pair: dict[str, Any]) -> str:
        sure = pair["confidence"]
        confidence = "> 99.99 %" if sure > 0.9999 else f"{100 * sure:.2f} %"
        return f"{names[pair['better'] - 1]} {relation} {names[pair['worse'] - 1]} (confidence {confidence})"

    lines = [
        f"Order, smallest measured error first: {', '.join(names[i - 1] for i in order['ranking'])}. "
        f"{order['distinguished']} of {order['pairs']} pairs differ significantly (level {order['level']:g} for all "
        "pairs together)."
    ]
    # Of each, only the nearest one below it that differs significantly: those further down add little.
    places = {number: place for place, number in enumerate(order["ranking"])}
    nearest: dict[int, dict[str, Any]] = {}
    for pair in sorted(order["distinctions"], key=lambda pair: places[pair["worse"]]):
        nearest.setdefault(places[pair["better"]], pair)
    for _, pair in sorted(nearest.items())[:most]:  # the name of a file keeps its first letter
        lines.append(sentence(named(pair)) if named(pair).startswith("agent ") else f"{named(pair)}.")
    if order["ties"] and order["distinguished"]:
        ties = [f"{names[a - 1]} and {names[b - 1]}" for a, b in order["ties"][:most]]
        lines.append(f"Not significantly different: {'; '.join(ties)}.")
    for pair in order["contradictions"][:most]:
        expected = "in the opposite order" if pair["predicted"] is False else "equal"
        lines.append(f"Measured, but predicted {expected}: {named(pair)}.")
    return lines


def furthest(z: Sequence[float | None], most: int) -> list[int]:
    """Places, from 0, of the ``most`` estimates with the largest abs(z), largest first."""
    return sorted(range(len(z)), key=lambda place: -abs(z[place] or 0.0))[:most]
