"""The offline twin: a run without ROS, by the same law and the same random numbers."""

from __future__ import annotations

import uuid
from collections.abc import Iterator

import numpy as np

from msg_analysis.model.arithmetic.payload import from_payload
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, normals
from msg_analysis.model.arithmetic.update_law import step, weighted_sum
from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.model.experiment.protocol_binding import AgentProtocol
from msg_analysis.model.run.agent_law import ProtocolLaw
from msg_analysis.model.run.graph_path import mode_path
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.run.trajectory import Completeness, Trajectory
from msg_analysis.model.step.air import LOST
from msg_analysis.model.step.air_reception import Reception, padded_inputs
from msg_analysis.model.step.process_noise import ProcessNoise
from msg_analysis.model.step.step_model import StepModel, Wiring, build_model, build_step_model
from msg_analysis.theory.prediction import stationary_start_factor
from msg_analysis.twin.ideal_timers import IdealTimers
from msg_analysis.types import BoolArray, FloatArray, IntArray


def draw_start(experiment: Experiment, model: Wiring, first_mode: int) -> FloatArray:
    """(m, replicas) x(0): zero, the given values, or drawn from N(reference, C_g0 / pi_g0).

    The last one needs a linear law.

    Parameters
    ----------
    experiment
        whose ``run.start`` and seed
    model
        its compiled step; the stationary start needs a ``StepModel``
    first_mode
        index of g(0); the stationary start depends on it
    """
    replicas = experiment.run.replicas
    start = experiment.run.start
    if start == "zero":
        return np.zeros((experiment.agents, replicas))
    if start != "stationary":
        return np.repeat(np.array(start, dtype=float)[:, None], replicas, axis=1)
    assert isinstance(model, StepModel), "experiments without a prediction start from given values"
    factor = stationary_start_factor(experiment, first_mode)
    sources = [normals(experiment.run.seed, Stream.START, j, 0, (replicas,)) for j in range(experiment.agents)]
    deviations = np.array([weighted_sum([float(w) for w in row], sources) for row in factor])
    return deviations + model.reference


def new_record(experiment: Experiment, run: uuid.UUID | None = None) -> RunRecord:
    """Everything that a new run of an experiment starts from.

    Parameters
    ----------
    experiment
        that is going to be run
    run
        run id; a new random one if not given
    """
    model = build_model(experiment)
    modes = mode_path(experiment, model.initial)
    start = draw_start(experiment, model, int(modes[0]))
    if experiment.protocol and not isinstance(model, StepModel):
        start = np.array([AgentProtocol(experiment.protocol, i).start(x).ravel() for i, x in enumerate(start)])
    return RunRecord(run or uuid.uuid4(), experiment, start)


def simulate(experiment: Experiment, *, record: RunRecord | None = None) -> Trajectory:
    """Run an experiment without ROS.

    Parameters
    ----------
    experiment
        what to run; with a record, that of the record
    record
        of the run to repeat; a new run with a new id if not given

    Returns
    -------
    Trajectory
        The same states, to the last bit, as those of a lockstep network run; in real time, as those of a run with ideal
        timers and no delay.
    """
    experiment = record.experiment if record else experiment
    experiment.require_available()
    record = record or new_record(experiment)
    if experiment.protocol and not experiment.protocol.linear:
        return _simulate_agents(record, build_model(experiment))
    model = build_step_model(experiment)
    modes = mode_path(experiment, model.initial)
    states = np.empty((experiment.steps + 1, *record.start.shape))
    states[0] = record.start
    drives = _drives(experiment, model, modes)
    if experiment.run.pace == "realtime":
        timers = IdealTimers(experiment, model)
        for k, state in enumerate(timers.states(modes, record.start, drives), start=1):
            states[k] = state
        agent_modes, used, made = timers.log(modes)
        whole = Completeness(states.shape[0] * states.shape[1], states.shape[0] * states.shape[1], 0)
        return Trajectory(record, states, modes, whole, agent_modes, used=used, made=made)
    reception = Reception(experiment, model) if experiment.noise.on_air else None
    for k, state in enumerate(_states(model, modes, record.start, drives, reception), start=1):
        states[k] = state
    published, lost = reception.log(states, modes) if reception else (None, None)
    expected = states.shape[0] * states.shape[1] * (1 if published is None else 2)
    return Trajectory(record, states, modes, Completeness(expected, expected, 0), published=published, lost=lost)


def _simulate_agents(record: RunRecord, model: Wiring) -> Trajectory:
    """The same by the laws of the single agents, one after the other, as the network has them."""
    experiment, agents = record.experiment, range(model.agents)
    modes = mode_path(experiment, model.initial)
    laws = [ProtocolLaw(record, model, i) for i in agents]
    neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in laws]
    states = np.empty((experiment.steps + 1, *record.start.shape))
    published = np.empty((experiment.steps + 1, model.agents, experiment.run.replicas))
    lost: BoolArray = np.zeros((experiment.steps, model.agents, model.most_neighbours), dtype=np.bool_)
    for k in range(experiment.steps + 1):
        values = [law.published(k, law.state) for law in laws]
        for i, law in enumerate(laws):
            states[k, i], published[k, i] = from_payload(law.state), from_payload(values[i])
        if k == experiment.steps:
            break
        mode = int(modes[k])
        for i, law in enumerate(laws):
            law.advance(mode, [values[j] for j in neighbours[i][mode]])
            lost[k, i, : len(law.heard)] = [step == LOST for step in law.heard]
    expected = states.shape[0] * states.shape[1] * (2 if experiment.truth else 1)
    return Trajectory(
        record,
        states,
        modes,
        Completeness(expected, expected, 0),
        published=published if experiment.truth else None,
        lost=lost if experiment.noise.loss else None,
    )


def _drives(experiment: Experiment, model: StepModel, modes: IntArray) -> Iterator[FloatArray]:
    """For every step of a path of graphs, (m, R): the noise of all agents, plus what the reference adds."""
    noise = ProcessNoise(experiment.run.seed, model.noise_gain, experiment.run.replicas)
    offsets = [offset[:, None] for offset in model.offsets]
    for k, mode in enumerate(modes):
        within = k % STEPS_PER_BLOCK
        if within == 0:
            noises = [noise.block(i, k // STEPS_PER_BLOCK) for i in range(model.agents)]
            drives: dict[int, FloatArray] = {}
        if mode not in drives:
            drives[mode] = np.stack([of_agent[mode] for of_agent in noises], axis=1) + offsets[mode]
        yield drives[mode][within]


def _states(
    model: StepModel, modes: IntArray, start: FloatArray, drives: Iterator[FloatArray], reception: Reception | None
) -> Iterator[FloatArray]:
    """x(1), x(2), ... of a path of graphs, everybody at once."""
    rows = [_padded_rows(model, mode) for mode in range(model.modes)]
    state = start
    for k, (mode, drive) in enumerate(zip(modes, drives, strict=True)):
        weights, inputs = rows[mode]
        values = reception.values(k, mode, state) if reception else [state[j] for j in inputs]
        state = step(weights, values, drive)
        yield state


def _padded_rows(model: StepModel, mode: int) -> tuple[list[FloatArray], list[IntArray]]:
    """All rows of W_mode at once: its d-th entries list holds every agent's d-th input, ascending, padded with zeros.

    Adding 0 * x at the end of a row changes nothing, so every row comes out as the agent computes it alone.
    """
    columns, there = padded_inputs(model, mode)
    weights = np.where(there, model.nominal[mode, np.arange(model.agents), columns], 0.0)
    return list(weights[:, :, None]), list(columns)
