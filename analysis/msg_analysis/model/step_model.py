# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What one step of all agents does: in lockstep all at once, in real time one after the other if no agent is late.

In real time, with g the graph of the period, an agent uses the new states of the agents that are due before it and the
old states of the others. Row by row, in the order of the phases,

    A_i = W_ii e_i + sum_earlier W_ij A_j + sum_later W_ij e_j,    B_i = F_i + sum_earlier W_ij B_j,

and offsets like B. Rows of A sum to 1 where those of W do, so consensus stays consensus; but A is not symmetric.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from msg_analysis.arithmetic.reproducible import Stream, exponential, generator
from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray, once
from msg_analysis.common.resources import one_blas_thread
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment.limits import matrix_problems
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule, require_chain

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


@dataclass(frozen=True, eq=False)
class Wiring:
    """Which agent uses the values of which agents in which graph, and the law of the graphs; all count from 0."""

    links: BoolArray  # (n, m, m) whether agent i uses what agent j publishes; the diagonal has no meaning
    switching: MarkovChain | Schedule  # between the graphs
    initial: FloatArray  # (n,) law of g(0)
    dt: float  # simulated time of a step
    losses: FloatArray  # (m, m) probability that a message from agent j (column) to agent i (row) is lost
    burst: float | None  # mean number of messages of a link that are lost in a row; None: losses are independent
    whole_link: bool  # whether a loss takes both directions of a link

    @property
    def loss(self) -> float:
        """Largest probability of any link that a message is lost."""
        return float(self.losses.max())

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return int(self.links.shape[0])

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return int(self.links.shape[1])

    @property
    def chain(self) -> MarkovChain:
        """The Markov chain; NotAvailableError where there is a schedule."""
        return require_chain(self.switching)

    @property
    def transition(self) -> FloatArray:
        """(n, n) P, the law of the graph one step later; where there is a schedule, which switches, the identity."""
        if isinstance(self.switching, Schedule):
            return np.eye(self.modes)
        return _transition(self.chain, self.dt)

    @property
    def stationary(self) -> FloatArray:
        """(n,) stationary law pi of the graph; of a schedule, the shares of time."""
        return self.switching.stationary

    def inputs(self, mode: int, agent: int) -> IntArray:
        """(d,) agents, ascending, with values that an agent uses under a mode; the agent itself is always included."""
        used = self.links[mode, agent].copy()
        used[agent] = True
        return np.flatnonzero(used)

    def neighbours(self, mode: int, agent: int) -> IntArray:
        """(d,) the other agents, ascending, with values that an agent uses under a mode."""
        used = self.inputs(mode, agent)
        return np.asarray(used[used != agent])

    @cached_property
    def most_neighbours(self) -> int:
        """Largest number D of neighbours that any agent has in any graph."""
        return int(self.links.sum(axis=2, where=~np.eye(self.agents, dtype=bool)).max())

    def listens(self) -> BoolArray:
        """(m, m): whether agent i uses the state of agent j != i in any graph."""
        used: BoolArray = np.asarray(self.links.any(axis=0))
        np.fill_diagonal(used, False)
        return used


@dataclass(frozen=True, eq=False)
class StepModel(Wiring):
    """x(k+1) = W_g(k) x(k) + offset_g(k) + noise, then g jumps with P."""

    # The step k -> k+1 uses g(k). With a delay d, the entries of W_g(k) off the diagonal take x(k - d) instead of x(k),
    # and x(k) = x(0) before the start. weights, noise and loss_variance are for agents that step all at once and lose
    # messages independently, each replaced by the agent's own value.

    # (n, m, m) W_g with its mean over lost messages: where one is lost, its weight falls to the agent itself
    weights: FloatArray
    # (n, m, m) W_g when nothing is lost: I - dt Z_g (continuous time, Euler) or exp(-Z_g) (discrete time), or what a
    # linear protocol says; rows of grounded leaders are zero
    nominal: FloatArray
    offsets: FloatArray  # (n, m) what the reference adds, so that the reference is a fixed point
    # (n, m, m) B_g: the process noise of a step is B_g v with v ~ N(0, I), the same v whatever g
    noise_gain: FloatArray
    noise: FloatArray  # (n, m, m) covariance N_g of all that is random in a step: B_g B_g^T plus noise on the air
    delay: int  # age d, in steps, of the states of others that a step uses
    # (n, m, m) p_ij (1 - p_ij) (nominal W_g)_ij^2 off the diagonal: ``weights`` is the mean over losses, and their
    # spread adds sum_ij variance_g[i, j] (x_i - x_j)^2 e_i e_i^T to the second moment
    loss_variance: FloatArray
    grounded: BoolArray  # (m,) True for leaders of infinite gain
    reference: float  # what tracking agents should hold; 0 for consensus
    broadcast: float  # standard deviation of the noise in what an agent publishes
    link: float  # standard deviation of the noise that a receiver adds
    holds: bool  # whether the last value heard takes the place of a lost one, and not the agent's own
    turns: IntArray | None = None  # (m,) agents in the order of their steps in a period; None: all at once

    @property
    def by_message(self) -> bool:
        """Whether ``weights``, ``noise`` and ``loss_variance`` are not all: values are kept from step to step."""
        bursts = self.burst is not None and self.loss > 0.0
        return self.holds or bursts or self.turns is not None


@dataclass(frozen=True, slots=True, eq=False)
class StepMatrices:
    """The numbers of a linear step, which the record of a run carries where linear algebra made them."""

    weights: FloatArray  # (n, m, m) W_g when nothing is lost: ``StepModel.nominal``
    noise_gain: FloatArray  # (n, m, m) B_g


@lru_cache(maxsize=16)
def _transition(chain: MarkovChain, dt: float) -> FloatArray:
    with one_blas_thread():
        transition = chain.transition(dt)
    transition.flags.writeable = False
    return transition


def build_model(experiment: Experiment, matrices: StepMatrices | None = None) -> Wiring:
    """A ``StepModel`` where the law is linear, else the wiring alone; ``matrices`` are those of the run record."""
    if experiment.protocol is None or experiment.protocol.linear:
        return build_step_model(experiment, matrices)
    _require_memory(experiment)
    return Wiring(
        links=_arcs(experiment),
        switching=experiment.switching_law,
        initial=first_graph(experiment),
        dt=experiment.step_length,
        losses=experiment.loss,
        burst=experiment.noise.burst,
        whole_link=bool(experiment.noise.whole_link),
    )


def step_matrices(experiment: Experiment) -> StepMatrices:
    """Compute the matrices of a step. InputError: a protocol that is not linear, is not available, or fails."""
    agents, dt = experiment.agents, experiment.step_length
    grounded = np.isinf(experiment.leader_gains)
    if experiment.protocol:
        weights, gain = experiment.protocol.matrices()
        weights[:, range(agents), range(agents)] -= dt * np.where(grounded, 0.0, experiment.leader_gains)
        weights[:, grounded] = 0.0
    else:
        weights, gain = _built_in(experiment), step_noise_gain(experiment)
    if experiment.time == "continuous" and grounded.any():
        gain = np.where(grounded[:, None], 0.0, gain)  # a leader held at the reference has no noise either
    return StepMatrices(weights, gain)


def build_step_model(experiment: Experiment, matrices: StepMatrices | None = None) -> StepModel:
    """What one step of an experiment does; ``matrices`` are those of the run record, or of ``step_matrices``."""
    _require_memory(experiment)
    if matrices is None:
        matrices = step_matrices(experiment)
    weights, gain = matrices.weights, matrices.noise_gain
    agents, dt = experiment.agents, experiment.step_length
    grounded = np.isinf(experiment.leader_gains)
    links = _arcs(experiment) & ~grounded[:, None] if experiment.protocol else weights != 0.0
    reference = experiment.reference
    offsets = reference * (1.0 - weights.sum(axis=2)) if reference else np.zeros(weights.shape[:2])

    loss, air = experiment.loss, experiment.noise  # (m, m)
    mean, variance = weights, np.broadcast_to(np.zeros((agents, agents)), weights.shape)
    noise = np.broadcast_to(once(gain) @ once(gain).transpose(0, 2, 1), weights.shape)
    if air.on_air:
        coupling = weights * ~np.eye(agents, dtype=bool)
    if air.link or air.broadcast:
        noise = noise.copy()
        for mode, a in enumerate(coupling):
            kept = (1 - loss) * a
            noise[mode] += air.link**2 * np.diag((kept * a).sum(axis=1))
            noise[mode] += air.broadcast**2 * (kept @ kept.T + np.diag((loss * kept * a).sum(axis=1)))
    if air.loss.any:
        lost = loss * coupling
        mean = weights - lost
        mean[:, range(agents), range(agents)] += lost.sum(axis=2)
        variance = loss * (1 - loss) * coupling**2
    return StepModel(
        links=links,
        weights=mean,
        nominal=weights,
        offsets=offsets,
        noise_gain=gain,
        noise=noise,
        delay=experiment.noise.delay,
        losses=loss,
        burst=experiment.noise.burst,
        whole_link=bool(experiment.noise.whole_link),
        loss_variance=variance,
        switching=experiment.switching_law,
        initial=first_graph(experiment),
        grounded=grounded,
        reference=reference,
        dt=dt,
        broadcast=experiment.noise.broadcast,
        link=experiment.noise.link,
        holds=experiment.noise.holds,
    )


def _require_memory(experiment: Experiment) -> None:
    if found := matrix_problems(experiment):
        raise NotAvailableError("\n".join(found))


def step_noise_gain(experiment: Experiment) -> FloatArray:
    """(n, m, m) sqrt(dt) F_i: the noise that a step of the built-in law adds is this times N(0, I)."""
    gain = experiment.noise_gain
    gain = np.broadcast_to(np.sqrt(experiment.step_length) * once(gain), gain.shape)
    if experiment.graph_list[0].active is None:
        return gain
    return np.where(_active(experiment)[:, :, None], gain, 0.0)


def _active(experiment: Experiment) -> BoolArray:
    """(n, m): which agents make a step with each graph."""
    return np.array([graph.active for graph in experiment.graph_list], dtype=np.bool_)


def _built_in(experiment: Experiment) -> FloatArray:
    """(n, m, m): W_g of the law that the agents have by themselves, with its leaders."""
    gains, agents = experiment.leader_gains, experiment.agents
    grounded = np.isinf(gains)
    follows = ~grounded
    bases = [graph.whole or graph for graph in experiment.graph_list]
    different = {id(base): base for base in bases}
    weights = np.zeros((len(different), agents, agents))
    for mode, graph in enumerate(different.values()):
        z = graph.laplacian + np.diag(np.where(grounded, 0.0, gains))
        if experiment.time == "continuous":
            weights[mode] = np.eye(agents) - experiment.step_length * z
            weights[mode, grounded] = 0.0
        else:
            # The limit of exp(-(L + K)) for gains to infinity: leaders forget, followers no longer hear them.
            block = np.ix_(follows, follows)
            weights[mode][block] = exponential(-z[block])
    if len(different) < len(bases):
        place = {key: mode for mode, key in enumerate(different)}
        weights = weights[[place[id(base)] for base in bases]]
    if experiment.graph_list[0].active is not None:
        rests = ~_active(experiment) & follows
        weights[rests] = np.eye(agents)[np.nonzero(rests)[1]]
    return weights


def first_graph(experiment: Experiment) -> FloatArray:
    """(n,): the law of g(0)."""
    first = experiment.switching.initial
    if experiment.schedule:
        return np.asarray(np.arange(len(experiment.graph_list)) == experiment.schedule.order[0], dtype=float)
    if first == "stationary":
        return experiment.switching_law.stationary
    return np.array([float(graph.name == first) for graph in experiment.graph_list])


def _arcs(experiment: Experiment) -> BoolArray:
    """(n, m, m): whether agent i hears agent j, as the graphs say."""
    return np.array([graph.adjacency != 0.0 for graph in experiment.graph_list])


StepLaw = Literal["synchronous", "sequential"]


def step_law(experiment: Experiment) -> StepLaw:
    """Whether the agents of a run step all at once (lockstep) or one after the other (real time)."""
    return "sequential" if experiment.run.pace == "realtime" else "synchronous"


def phases(experiment: Experiment) -> FloatArray:
    """(m,) phi_i = (rank_i + 1/2) / m in real time: agent i steps from x(k) to x(k+1) at (k + phi_i) dt.

    Those of unsynchronised timers of equal period: spread evenly over it, in an order drawn from the seed.
    """
    ranks = generator(experiment.run.seed, Stream.PHASE).permutation(experiment.agents)
    return np.asarray((ranks + 0.5) / experiment.agents)


def turns(experiment: Experiment) -> IntArray | None:
    """(m,) agents in the order of their steps in a period; None: all at once."""
    return None if step_law(experiment) == "synchronous" else np.argsort(phases(experiment))


def ahead(order: IntArray | None, agents: int) -> IntArray:
    """(m, m) by receiver and sender: 1 where the sender steps first, given the ``turns``, else 0."""
    rank = np.zeros(agents) if order is None else np.argsort(order)
    return np.asarray((rank < rank[:, None]).astype(np.int64))


def build_run_model(experiment: Experiment, step: StepModel | None = None) -> StepModel:
    """What a step of all agents of a run does to x(k); ``step``: the model of the experiment, if it is known."""
    step, order = step or build_step_model(experiment), turns(experiment)
    if order is None:
        return step
    if experiment.noise.on_messages:  # with messages that are noisy, late or lost, the micro-steps stay apart
        return dataclasses.replace(step, turns=order)
    return sequential(step, order)


def sequential(step: StepModel, order: IntArray) -> StepModel:
    """The agents' micro-steps of a period, in the order of their ``turns`` (m,), as one step; no noise on the air."""
    weights, offsets, gain = np.empty_like(step.weights), np.empty_like(step.offsets), np.empty_like(step.noise_gain)
    done = np.zeros(step.agents, dtype=bool)
    for i in order.tolist():
        row = step.nominal[:, i]
        new = row * done
        weights[:, i] = (row - new) + np.einsum("nj,njk->nk", new[:, done], weights[:, done])
        gain[:, i] = step.noise_gain[:, i] + np.einsum("nj,njk->nk", new[:, done], gain[:, done])
        offsets[:, i] = step.offsets[:, i] + np.einsum("nj,nj->n", new[:, done], offsets[:, done])
        done[i] = True
    return dataclasses.replace(
        step, weights=weights, nominal=weights, offsets=offsets, noise_gain=gain, noise=gain @ gain.transpose(0, 2, 1)
    )
