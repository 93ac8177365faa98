"""An experiment in sentences, for the HTML report."""

from __future__ import annotations

import math
from typing import Any

from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.model.experiment.problems import show
from msg_analysis.report.documents.info import algebraic_connectivity, holding_times


def explain(experiment: Experiment) -> list[str]:
    """What the agents do, what switches, what is random, and what was run: a short paragraph each."""
    return [_task(experiment), _switching(experiment), _noise(experiment), _run(experiment)]


def graph_facts(experiment: Experiment) -> list[dict[str, Any]]:
    """Of every graph: ``name``, ``links``, ``directed``, ``connectivity``, ``share`` (predicted, of time), ``held``.

    ``held`` is the mean holding time [units of simulated time]; None for a graph that is never left.
    """
    rows = zip(experiment.graph_list, experiment.chain.stationary, holding_times(experiment), strict=True)
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
    agents, leaders = experiment.agents, experiment.leaders
    if experiment.protocol:
        info = experiment.protocol.info
        kind = "linear" if info.linear else "not linear, so theory predicts nothing for it"
        return f"{agents} agents follow the protocol {info.name} of the package {info.package} ({kind})."
    text = f"{agents} agents hold one number each, and keep moving it towards the numbers that they hear of others"
    if leaders is None:
        return (
            f"{text}, to agree on one (consensus). An agent's error is the mean square of its distance from the "
            "average of all; the system error is the sum over the agents."
        )
    one = len(leaders.agents) == 1
    who = f"agent {leaders.agents[0]}, knows" if one else f"agents {show(leaders.agents)[1:-1]}, know"
    pull = (
        f"{'is' if one else 'are'} held at it"
        if math.isinf(leaders.gain)
        else f"{'is' if one else 'are'} drawn to it with gain {leaders.gain:g}"
    )
    return (
        f"{text}; the {'leader' if one else 'leaders'}, {who} the reference {leaders.reference:g} and {pull}. "
        "An agent's error is the mean square of its distance from the reference; the system error is the sum over "
        "the agents."
    )


def _switching(experiment: Experiment) -> str:
    modes, chain = len(experiment.graph_list), experiment.chain
    if modes == 1:
        return f"Who hears whom is always the same: the graph {experiment.graph_list[0].name}."
    first = experiment.switching.initial
    begin = (
        "The first graph is drawn from the law of how much time each has."
        if first == "stationary"
        else f"The first graph is {first}."
    )
    if chain.time == "discrete":
        return f"Who hears whom is one of {modes} graphs, drawn anew in every step by a Markov chain. {begin}"
    times = [time for time in holding_times(experiment) if time is not None]
    held = f"{min(times):.3g}" if max(times) - min(times) < 1e-9 else f"{min(times):.3g} to {max(times):.3g}"
    return (
        f"Who hears whom is one of {modes} graphs, and jumps at random (a Markov chain in continuous time); a graph "
        f"stays for {held} units of time on average. {begin}"
    )


def _noise(experiment: Experiment) -> str:
    noise = experiment.noise
    process = noise.process
    size = f"of gain {process:g}" if isinstance(process, float | int) else "of a gain of its own, given as a matrix"
    if isinstance(process, dict):
        size = "whose gain depends on the graph"
    elif isinstance(process, list) and not isinstance(process[0], list):
        size = "of a gain of each agent's own"
    parts = [f"All the time noise {size} pushes the numbers about"]
    if noise.broadcast:
        parts.append(f"what an agent says is wrong by {noise.broadcast:g} (standard deviation), the same for all")
    if noise.link:
        parts.append(f"each receiver adds noise of {noise.link:g}")
    if noise.loss:
        parts.append(f"{100 * noise.loss:.3g} % of the messages are lost")
    if noise.delay:
        parts.append(f"what is heard is {noise.delay} steps old")
    return "; ".join(parts) + "."


def _run(experiment: Experiment) -> str:
    run = experiment.run
    copies = "1 copy" if run.replicas == 1 else f"{run.replicas} independent copies under the same graphs"
    start = {"stationary": "begun in the steady state", "zero": "begun at 0"}
    begun = start[run.start] if isinstance(run.start, str) else "begun at given values"
    if run.pace == "realtime":
        pace = (
            f"In real time: every agent steps by a timer of its own, {run.speed / experiment.step_length:.3g} times a "
            "second, with the newest values that it has."
        )
    else:
        pace = "In lockstep: all agents make the same step before the next."
    return (
        f"The run makes {experiment.steps} steps of {experiment.step_length:g} ({run.duration:g} units of simulated "
        f"time) of {copies}, {begun}. {pace}"
    )
