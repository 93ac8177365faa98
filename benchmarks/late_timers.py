"""Runs in real time with late agents and slow messages, without a network: for calibration and for tests.

Nothing here is shared with the twin or with the analysis but the experiment, its step model and its random numbers:
every agent is a plain loop over what has reached it.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.agent_law import ProcessNoise
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.step_model import StepModel, build_step_model, phases
from msg_analysis.twin.simulate import new_record

Lateness = Callable[[np.random.Generator], float]


def never(_random: np.random.Generator) -> float:
    """No lateness."""
    return 0.0


def busy(share: float, mean: float) -> Lateness:
    """Late in some of the steps, by an exponential time [periods]; on time in the others."""
    return lambda random: float(random.exponential(mean)) if random.random() < share else 0.0


def run(
    experiment: Experiment,
    *,
    late: Lateness = never,
    slow: Lateness = never,
    switch: Lateness = never,
    timing_seed: int = 1,
    truth: Callable[[StepModel], StepModel] | None = None,
) -> Run:
    """Run an experiment of pace realtime.

    Parameters
    ----------
    late
        how long after it is due an agent's timer fires [periods]; what has become due meanwhile is caught up
    slow
        how long a state is under way to each neighbour [periods]
    switch
        how long a switch of the graph is under way to each agent [periods]
    timing_seed
        of all this
    truth
        what the agents really do, given what they should
    """
    random = np.random.default_rng(timing_seed)
    record = new_record(experiment)
    claimed = build_step_model(experiment)
    model = truth(claimed) if truth else claimed
    modes = mode_path(experiment, claimed.initial)
    phase, m, steps = phases(experiment), experiment.agents, experiment.steps
    noise = ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas)
    states = np.full((steps + 1, m, experiment.run.replicas), np.nan)
    states[0] = record.start
    agent_modes = np.full((steps + 1, m), -1)
    used = np.full((steps, m, model.most_neighbours), -1)
    made = np.zeros((steps + 1, m), dtype=np.int64)
    blocks: dict[tuple[int, int], list[np.ndarray]] = {}
    # As plain numbers and lists, which are read one by one.
    weights, offsets = model.nominal.tolist(), model.offsets.tolist()
    inputs = [[model.inputs(g, i).tolist() for i in range(m)] for g in range(model.modes)]

    switches = [0, *np.flatnonzero(np.diff(modes) != 0) + 1]
    # What agent i has of agent j, and the newest holding period that it has.
    has = [[-1] * m for _ in range(m)]
    graph = [int(modes[0])] * m
    newest_switch, done = [0] * m, [0] * m
    # time [periods], tie-breaker, what happens
    events: list[tuple[float, int, str, tuple[int, ...]]] = []
    count = 0

    def at(time: float, kind: str, *what: int) -> None:
        nonlocal count
        count += 1
        heapq.heappush(events, (time, count, kind, what))

    for k in switches[1:]:
        for i in range(m):
            at(k + switch(random), "graph", i, k)
    for i in range(m):
        for j in range(m):
            at(slow(random), "state", j, i, 0)
        at(phase[i] + late(random), "timer", i)
    while events:
        now, _, kind, what = heapq.heappop(events)
        if kind == "graph":
            i, k = what
            if k > newest_switch[i]:
                newest_switch[i], graph[i] = k, int(modes[k])
        elif kind == "state":
            i, j, s = what
            has[i][j] = max(has[i][j], s)
        else:
            (i,) = what
            while done[i] < steps and done[i] + phase[i] <= now:
                k, g = done[i], graph[i]
                key = i, k // STEPS_PER_BLOCK
                if key not in blocks:
                    blocks[key] = noise.block(*key)
                # Summed in the order of docs/network.md, so that runs are those of the law to the last bit.
                x, d = np.full(experiment.run.replicas, -0.0), 0
                for j in inputs[g][i]:
                    value = states[k, i]
                    if j != i:
                        used[k, i, d] = s = has[i][j]
                        d += 1
                        if s >= 0:  # else nothing has been heard of it yet
                            value = states[s, j]
                    x = x + weights[g][i][j] * value
                states[k + 1, i] = x + (blocks[key][g][k % STEPS_PER_BLOCK] + offsets[g][i])
                agent_modes[k + 1, i] = g
                made[k + 1, i] = round(now * experiment.step_length * 1e9)
                done[i] += 1
                for j in range(m):
                    if j != i:
                        at(now + slow(random), "state", j, i, k + 1)
            if done[i] < steps:
                at(max(now, done[i] + phase[i] + late(random)), "timer", i)
    expected = (steps + 1) * m
    whole = Completeness(expected, expected, 0)
    return Run(record, states, modes, whole, agent_modes, used=used, made=made)
