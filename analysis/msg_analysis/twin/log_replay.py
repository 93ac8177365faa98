# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The twin of a run in real time: from what every agent logged of each step, what must have come out of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK
from msg_analysis.arithmetic.update_law import from_payload, to_payload
from msg_analysis.arithmetic.update_law import step as update
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.model.agent_law import ProtocolLaw
from msg_analysis.model.reception import NOTHING, Air, add_broadcast_noise, by_sender_and_block, neighbour_tables
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import StepModel
from msg_analysis.twin.simulate import RunBlock, from_start, noise_of_all


def replay(trajectory: Run) -> Iterator[RunBlock]:
    """What the law gives from the logged inputs of every step: ``states`` and ``published``; NaN where inputs miss."""
    # By induction, a log in real time that equals this from x(0) on is what the law gives for the start, the seed, and
    # the values that the agents used.
    if trajectory.used is None or trajectory.agent_modes is None or trajectory.made is None:
        raise ValueError("a run in lockstep: its twin is `simulate`")
    record, model = trajectory.record, trajectory.record.model
    law = _LinearReplay(trajectory, model) if isinstance(model, StepModel) else _ProtocolReplay(trajectory)
    steps = range(0, len(trajectory.used), STEPS_PER_BLOCK)
    for first, states in from_start(record.start, (law.made(slice(k, k + STEPS_PER_BLOCK)) for k in steps)):
        published = None
        if trajectory.published is not None:
            published = law.published(first, trajectory.states[first : first + len(states)])
        yield RunBlock(first, states, published)


class _LinearReplay:
    """Steps of a linear law. Each follows from the log alone, so that many are made at once."""

    def __init__(self, trajectory: Run, model: StepModel) -> None:
        self._log, self._model = trajectory, model
        self._air = Air(trajectory.record.experiment)
        self._noise = noise_of_all(trajectory.record.experiment, model)
        self._tables = neighbour_tables(model)
        self._terms = [_terms(model, i) for i in range(model.agents)]

    def made(self, steps: slice) -> FloatArray:
        """(K, m, R) states after the steps of a block."""
        return np.stack([self._made_by(i, steps) for i in range(self._model.agents)], axis=1)

    def published(self, first: int, states: FloatArray) -> FloatArray:
        """(K, m, R) what is published of x(first), ..., ``states``."""
        return add_broadcast_noise(self._air, states, first)

    def _made_by(self, i: int, steps: slice) -> FloatArray:
        log = self._log
        assert log.used is not None
        assert log.agent_modes is not None
        used = log.used[steps, i]
        mode, each = log.agent_modes[1:][steps, i], np.arange(len(used))
        own = log.states[steps.start : steps.start + len(used), i]
        heard = np.where(
            (used == NOTHING)[..., None], own[:, None], self._heard(i, used, self._tables.senders[mode, i])
        )
        values = np.concatenate([own[:, None], heard], axis=1)
        places, weights = self._terms[i]
        noise = self._noise.block(i, steps.start // STEPS_PER_BLOCK, len(used))
        drive = np.stack(noise)[mode, each] + self._model.offsets[mode, i][:, None]
        terms = [(weights[mode, d][:, None], values[each, places[mode, d]]) for d in range(places.shape[1])]
        made = update([weight for weight, _ in terms], [value for _, value in terms], drive)
        made[mode < 0] = np.nan
        return made

    def _heard(self, i: int, used: IntArray, senders: IntArray) -> FloatArray:
        """(K, D, R) the messages of these steps from ``senders``, as agent i received them; any where none was used."""
        published = self._log.states if self._log.published is None else self._log.published
        values = np.asarray(published[np.maximum(used, 0), senders])
        if self._air.link:
            for j, number, these, within in by_sender_and_block(senders, used):
                values[these] += self._air.link_noise(i, j, number)[within]
        return values


def _terms(model: StepModel, i: int) -> tuple[IntArray, FloatArray]:
    """(n, D + 1) place of every term of the sums of agent i among its value and those of its neighbours; weights."""
    places = np.zeros((model.modes, model.most_neighbours + 1), dtype=np.int64)
    weights = np.zeros(places.shape)  # of 0, which change no sum, beyond the last
    for mode in range(model.modes):
        inputs = model.inputs(mode, i)
        others = np.cumsum(inputs != i)
        places[mode, : len(inputs)] = np.where(inputs == i, 0, others)
        weights[mode, : len(inputs)] = model.nominal[mode, i, inputs]
    return places, weights


class _ProtocolReplay:
    """The same of a protocol, agent by agent and step by step."""

    def __init__(self, trajectory: Run) -> None:
        self._log = trajectory
        record, model = trajectory.record, trajectory.record.model
        self._laws = [ProtocolLaw(record, model, i) for i in range(model.agents)]
        self._neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in self._laws]

    def made(self, steps: slice) -> FloatArray:
        """See _LinearReplay."""
        first, end, _ = steps.indices(len(self._log.states) - 1)
        made = np.full((end - first, *self._log.states.shape[1:]), np.nan)
        for k in range(first, end):
            for i in range(len(self._laws)):
                self._advance(k, i, made[k - first, i])
        return made

    def published(self, first: int, states: FloatArray) -> FloatArray:
        """See _LinearReplay."""
        assert self._log.published is not None
        published = np.full((len(states), *self._log.published.shape[1:]), np.nan)
        for k, i in np.argwhere(~np.isnan(states).any(axis=2)).tolist():
            published[k, i] = from_payload(self._laws[i].published(first + k, to_payload(states[k, i])))
        return published

    def _advance(self, k: int, i: int, made: FloatArray) -> None:
        log, law = self._log, self._laws[i]
        assert log.used is not None
        assert log.agent_modes is not None
        heard_of = log.states if log.published is None else log.published
        mode, state = int(log.agent_modes[k + 1, i]), log.states[k, i]
        if mode < 0 or np.isnan(state).any():
            return
        senders = self._neighbours[i][mode]
        steps = log.used[k, i, : len(senders)].tolist()
        heard = [heard_of[max(step, 0), j] for step, j in zip(steps, senders, strict=True)]
        if any(step != NOTHING and np.isnan(value).any() for step, value in zip(steps, heard, strict=True)):
            return
        if law.step != k:
            law.resume(k, to_payload(state))
        law.state = to_payload(state)
        made[:] = from_payload(law.advance(mode, [to_payload(value) for value in heard], steps))
