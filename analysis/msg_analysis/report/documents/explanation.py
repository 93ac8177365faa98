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

"""An experiment in sentences, for the HTML report."""

from __future__ import annotations

import math
from typing import Any

from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.common.text.number_words import listed
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.theory.graph_indices import algebraic_connectivity


def explain(experiment: ValidExperiment) -> list[str]:
    """What the agents do, what switches, what is random, and what was run: a short paragraph each."""
    return [_task(experiment), _switching(experiment), _noise(experiment), _run(experiment)]


def graph_facts(experiment: ValidExperiment) -> list[dict[str, Any]]:
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


def _task(experiment: ValidExperiment) -> str:
    agents, leaders = experiment.agents, experiment.leaders
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


def _switching(experiment: ValidExperiment) -> str:
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


def _noise(experiment: ValidExperiment) -> str:
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


def _losses(experiment: ValidExperiment) -> str:
    noise, loss = experiment.noise, experiment.noise.loss
    text = f"{100 * loss.default:.3g} % of the messages are lost"
    if special := [probability for *_, probability in (*loss.arcs, *loss.edges)]:
        span = " to ".join(sorted({f"{100 * p:.3g}" for p in (min(special), max(special))}, key=float))
        text += f", and {span} % of those of {len(special)} link{'s' if len(special) > 1 else ''}"
    if noise.burst is not None:
        text += f", on average {noise.burst:.3g} of a link in a row"
    return text + (", and the last value that was heard takes the place of a lost one" if noise.holds else "")


def _run(experiment: ValidExperiment) -> str:
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
