# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What an experiment is too large for: memory, runs, and exact predictions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from msg_analysis.common.resources import available_memory
from msg_analysis.common.text import amount
from msg_analysis.experiment.markov_chain import DrawnSchedule
from msg_analysis.experiment.problems import problem
from msg_analysis.experiment.spec import Purpose
from msg_analysis.experiment.validation import heard_links

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

MOST_STATES = 512
"""Of graph and links together, in a prediction with losses in bursts."""
MOST_GIVEN = 4096
"""The same where the sequence of the graphs is given."""
MOST_VALUES = 1500
"""That agents keep from step to step, in a prediction: the last ones heard, and those that a delay makes older."""

_PER_ARC = 24  # bytes: two ends and a weight
_MATRICES_PER_GRAPH = 8  # adjacency, W, its coupling, F, B, N, the variance of loss, and the product that makes N


def memory_needed(
    agents: int, modes: int, steps: int, replicas: int, delay: int = 0, truth: bool = False
) -> tuple[int, int]:
    """Bytes for the states of a run, and for the matrices of all graphs; ``replicas``: numbers in an agent's state."""
    # A delay [steps] makes the matrices larger. With truth, states are kept twice: as they are and as published.
    states = (steps + 1) * agents * replicas * 8 * (2 if truth else 1)
    return states, _MATRICES_PER_GRAPH * modes * (agents * (delay + 1)) ** 2 * 8


def memory_problems(agents: int, modes: int, steps: int, replicas: int, delay: int, truth: bool = False) -> list[str]:
    """Problems if states and matrices do not fit in memory; arguments as in ``memory_needed``."""
    available = available_memory()
    states, matrices = memory_needed(agents, modes, steps, replicas, delay, truth)
    if states + matrices <= available:
        return []
    room = f"expected at most {amount(available)}, the memory available"
    if matrices > states:
        if delay:
            text = f"{delay} steps with {modes} graphs of {agents} agents need {amount(matrices)}"
            return [problem("noise.delay", text, room, "lower the delay, or the number of agents or graphs")]
        text = f"{modes} graphs of {agents} agents need {amount(matrices)}"
        return [problem("graphs", text, room, "lower the number of agents or graphs")]
    text = f"{steps} steps of {agents} agents with {replicas} replicas need {amount(states)}"
    return [problem("run", text, room, "lower run.duration or run.replicas, or raise run.dt")]


def path_problems(arcs: int, switches: int, steps: int) -> list[str]:
    """Problems if the path of a run with drawn graphs does not fit; ``switches``: links, or agents, there or not."""
    graphs = min(steps, 2 ** min(switches, 62))
    needed, available = steps * switches + graphs * arcs * _PER_ARC, available_memory()
    if needed <= available:
        return []
    text = f"{steps} steps with up to {graphs} graphs of {arcs} arcs need {amount(needed)}"
    wanted = f"expected at most {amount(available)}, the memory available"
    return [problem("run", text, wanted, "lower run.duration, or the number of agents or links")]


def matrix_problems(experiment: Experiment) -> list[str]:
    """The same of an experiment with a schedule, which may have more graphs than matrices fit in memory."""
    size = len(experiment.graph_list), experiment.steps, experiment.width, experiment.noise.delay, experiment.truth
    return memory_problems(experiment.agents, *size) if experiment.schedule else []


def needs_sampling(experiment: Experiment) -> list[str]:
    """Matrices that do not fit in memory: only the sampled prediction does without."""
    if np.isfinite(experiment.noise_gain[0, 0, 0]):
        return []
    agents, modes = experiment.agents, len(experiment.graph_list)
    text = f"{modes} graphs of {agents} agents need {amount(memory_needed(agents, modes, 0, 0)[1])}"
    wanted = "expected matrices that fit in memory; only `predict` does without, by sampling"
    return [problem("graphs", text, wanted, "lower the number of agents or graphs")]


def unavailable(experiment: Experiment, purpose: Purpose = "run") -> list[str]:
    """What the experiment asks for that this version cannot do, one line each."""
    lines = why_sampled(experiment)
    if lines and not needs_sampling(experiment) and prediction_method(experiment)[0] == "sampled":
        lines[-1] += "; `predict` samples the steady errors"
    if purpose == "run":
        lines = needs_sampling(experiment) or matrix_problems(experiment)
    if purpose == "steady" and experiment.schedule and not isinstance(experiment.schedule, DrawnSchedule):
        wanted = "has no steady state, expected a Markov chain for this"
        lines.append(
            problem("switching.schedule", "a given sequence of graphs", wanted, "use predict, run and compare")
        )
    return lines + (experiment.protocol.unavailable(purpose) if experiment.protocol else [])


def prediction_method(experiment: Experiment) -> tuple[Literal["exact", "sampled", "measured"], str | None]:
    """How the steady errors of an experiment are known, or those of runs only; and why not exactly."""
    if experiment.protocol and (reason := experiment.protocol.unpredictable()):
        return "measured", reason
    if not (lines := why_sampled(experiment)):
        return "exact", None
    given = experiment.schedule and not isinstance(experiment.schedule, DrawnSchedule)
    in_bursts = dense_links(experiment) and experiment.noise.burst is not None
    return "measured" if given or in_bursts else "sampled", lines[0]


def dense_links(experiment: Experiment) -> bool:
    """Whether there are no sparse steps of single links, or of agents that leave out steps."""
    return experiment.links is not None and (experiment.time == "discrete" or experiment.protocol is not None)


def why_sampled(experiment: Experiment) -> list[str]:
    """What makes the steady errors too large for an exact prediction, one line each; none where there is one."""
    lines, links = too_large_to_predict(experiment), len(experiment.links or ())
    if 2**links > MOST_STATES:
        wanted = f"has no exact prediction: 2^{links} graphs, expected at most {MOST_STATES}"
        key, value, remedy = "switching.links", "links that switch by themselves", "use fewer links"
        if experiment.noise.leaves_out_steps:
            key, value, remedy = "noise.activation", str(experiment.noise.activation), "use fewer agents"
        lines.append(problem(key, value, wanted, remedy))
    return lines


def unpredictable(experiment: Experiment) -> str | None:
    """Why there is no prediction, as a part of a sentence; None where there is one."""
    reason = experiment.protocol.unpredictable() if experiment.protocol else None
    return reason or next(iter(too_large_to_predict(experiment)), None)


def too_large_to_predict(experiment: Experiment) -> list[str]:
    """What makes the exact errors of a run too large, given its graphs where no chain of these is known; as above."""
    if lines := needs_sampling(experiment):
        return lines
    noise, graphs, gains = experiment.noise, experiment.graph_list, experiment.leader_gains
    links = heard_links(graphs, experiment.time) & np.isfinite(gains)[:, None]
    lossy = int((links & (experiment.loss > 0.0)).sum())
    most = MOST_GIVEN if experiment.schedule else MOST_STATES
    if noise.burst is not None and len(graphs) * 2**lossy > most:
        wanted = f"has no exact prediction: 2^{lossy} states of {lossy} links that lose messages, expected at most "
        wanted += f"{most} with those of the graph"
        lines.append(problem("noise.burst", noise.burst, wanted, "remove it, or give fewer links a loss"))
    others = [key for key in ("broadcast", "link", "delay", "burst") if getattr(noise, key)]
    others += ["on_loss: hold"] * noise.holds + ["run.pace: realtime"] * (experiment.run.pace == "realtime")
    if noise.whole_link and others:
        wanted = f"has no exact prediction with {', '.join(others)}"
        lines.append(problem("noise.whole_link", True, wanted, "remove one of them"))
    kept = len(gains) * (noise.delay + 2) + lossy * (noise.delay + 1) * noise.holds
    by_message = noise.holds or (experiment.run.pace == "realtime" and noise.on_messages)
    if by_message and kept > MOST_VALUES:
        wanted = f"has no exact prediction: {kept} values are kept from step to step, expected at most {MOST_VALUES}"
        lines.append(problem("noise.on_loss", noise.on_loss, wanted, "use fewer agents or links, or own values"))
    return lines
