"""What one step of a run does: the experiment compiled to a discrete-time Markov jump linear system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from msg_analysis.model.arithmetic.matrix_exponential import exponential
from msg_analysis.model.network.markov_chain import MarkovChain
from msg_analysis.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.experiment import Experiment


@dataclass(frozen=True, slots=True, eq=False)
class Wiring:
    """Who uses whose values under which graph, and how the graphs follow each other: all that is true of any law.

    Modes and agents count from 0 here.

    Attributes
    ----------
    links
        (n, m, m) whether agent i uses what agent j publishes; the diagonal means nothing
    chain
        the Markov chain that switches between the graphs
    initial
        (n,) law of g(0)
    dt
        simulated time of a step
    loss
        probability that a directed message is ignored in a step
    """

    links: BoolArray
    chain: MarkovChain
    initial: FloatArray
    dt: float
    loss: float

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return int(self.links.shape[0])

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return int(self.links.shape[1])

    @property
    def transition(self) -> FloatArray:
        """(n, n) P, the law of the graph one step later."""
        return _transition(self.chain, self.dt)

    @property
    def stationary(self) -> FloatArray:
        """(n,) stationary law pi of the graph."""
        return self.chain.stationary

    def inputs(self, mode: int, agent: int) -> IntArray:
        """Agents, ascending, whose values an agent uses under a mode; the agent itself always among them.

        Parameters
        ----------
        mode
            graph, from 0
        agent
            index from 0

        Returns
        -------
        IntArray
            (d,) indices from 0
        """
        used = self.links[mode, agent].copy()
        used[agent] = True
        return np.flatnonzero(used)

    def neighbours(self, mode: int, agent: int) -> IntArray:
        """The other agents, ascending, whose values an agent uses under a mode.

        Parameters
        ----------
        mode
            graph, from 0
        agent
            index from 0

        Returns
        -------
        IntArray
            (d,) indices from 0
        """
        used = self.inputs(mode, agent)
        return np.asarray(used[used != agent])

    @property
    def most_neighbours(self) -> int:
        """Largest number D of neighbours that any agent has in any graph."""
        return int(self.links.sum(axis=2, where=~np.eye(self.agents, dtype=bool)).max())

    def listens(self) -> BoolArray:
        """(m, m): whether agent i uses the state of agent j != i in any graph."""
        used: BoolArray = np.asarray(self.links.any(axis=0))
        np.fill_diagonal(used, False)
        return used


@dataclass(frozen=True, slots=True, eq=False)
class StepModel(Wiring):
    """x(k+1) = W_g(k) x(k) + offset_g(k) + noise, then g jumps with P: "what the network actually does".

    Convention: the step k -> k+1 uses g(k). With a delay d, the entries of W_g(k) off the diagonal take x(k - d)
    instead of x(k), and x(k) = x(0) before the start.

    Attributes
    ----------
    weights
        (n, m, m) W_g with its mean over lost messages: where one is lost, its weight falls to the agent itself
    nominal
        (n, m, m) W_g when nothing is lost: I - dt Z_g (continuous time, Euler) or exp(-Z_g) (discrete time), or what a
        linear protocol says; rows of grounded leaders are zero
    offsets
        (n, m) what the reference adds, so that the reference is a fixed point
    noise_gain
        (n, m, m) B_g: the process noise of a step is B_g v with v ~ N(0, I), the same v whatever g
    noise
        (n, m, m) covariance N_g of all that is random in a step: B_g B_g^T plus noise on the air
    delay
        age d, in steps, of the states of others that a step uses
    loss_variance
        (n, m, m) p (1 - p) (nominal W_g)_ij^2 off the diagonal: ``weights`` is the mean over losses, and their spread
        adds sum_ij variance_g[i, j] (x_i - x_j)^2 e_i e_i^T to the second moment
    grounded
        (m,) True for leaders of infinite gain
    reference
        what tracking agents should hold; 0 for consensus
    """

    weights: FloatArray
    nominal: FloatArray
    offsets: FloatArray
    noise_gain: FloatArray
    noise: FloatArray
    delay: int
    loss_variance: FloatArray
    grounded: BoolArray
    reference: float


@dataclass(frozen=True, slots=True, eq=False)
class StepMatrices:
    """The numbers of a linear step.

    In discrete time and with a protocol they come out of linear algebra, whose last bits may depend on processor and
    libraries. So a run computes them once, and its record carries them.

    Attributes
    ----------
    weights
        (n, m, m) W_g when nothing is lost: ``StepModel.nominal``
    noise_gain
        (n, m, m) B_g
    """

    weights: FloatArray
    noise_gain: FloatArray


@lru_cache(maxsize=16)
def _transition(chain: MarkovChain, dt: float) -> FloatArray:
    with threadpool_limits(1):
        transition = chain.transition(dt)
    transition.flags.writeable = False
    return transition


def build_model(experiment: Experiment, matrices: StepMatrices | None = None) -> Wiring:
    """What a run needs to know of its network: a ``StepModel`` where the law is linear, else its wiring alone.

    Parameters
    ----------
    experiment
        with a protocol or without
    matrices
        of the run record, if they are known
    """
    if experiment.protocol is None or experiment.protocol.linear:
        return build_step_model(experiment, matrices)
    return Wiring(
        links=_arcs(experiment),
        chain=experiment.chain,
        initial=first_graph(experiment),
        dt=experiment.step_length,
        loss=experiment.noise.loss,
    )


def step_matrices(experiment: Experiment, expm: Callable[[FloatArray], FloatArray] = exponential) -> StepMatrices:
    """Compute the matrices of an experiment's step.

    Parameters
    ----------
    experiment
        whose law is linear
    expm
        the exponential of a matrix (m, m)

    Raises
    ------
    InputError
        the experiment has a protocol that is not linear, not here, or fails
    """
    agents, dt = experiment.agents, experiment.step_length
    grounded = np.isinf(experiment.leader_gains)
    if experiment.protocol:
        weights, gain = experiment.protocol.matrices()
        weights[:, range(agents), range(agents)] -= dt * np.where(grounded, 0.0, experiment.leader_gains)
        weights[:, grounded] = 0.0
    else:
        weights, gain = _built_in(experiment, expm), built_in_noise_gain(experiment)
    if experiment.time == "continuous":
        gain[:, grounded] = 0.0  # a leader held at the reference has no noise either
    return StepMatrices(weights, gain)


def built_in_noise_gain(experiment: Experiment) -> FloatArray:
    """(n, m, m) B_g of the built-in law, grounded leaders aside: sqrt(dt) F."""
    return np.asarray(np.sqrt(experiment.step_length) * experiment.noise_gain)


def build_step_model(experiment: Experiment, matrices: StepMatrices | None = None) -> StepModel:
    """Compile an experiment to what one of its steps does.

    Parameters
    ----------
    experiment
        whose law is linear
    matrices
        of the run record; computed if not given

    Raises
    ------
    InputError
        the experiment has a protocol that is not linear, not here, or fails
    """
    if matrices is None:
        matrices = step_matrices(experiment)
    weights, gain = matrices.weights, matrices.noise_gain
    agents, dt = experiment.agents, experiment.step_length
    grounded = np.isinf(experiment.leader_gains)
    links = _arcs(experiment) & ~grounded[:, None] if experiment.protocol else weights != 0.0
    reference = experiment.reference
    offsets = reference * (1.0 - weights.sum(axis=2)) if reference else np.zeros(weights.shape[:2])

    coupling = weights * ~np.eye(agents, dtype=bool)
    loss = experiment.noise.loss
    noise = gain @ gain.transpose(0, 2, 1)
    for mode, a in enumerate(coupling):
        per_link = np.diag((a**2).sum(axis=1))
        noise[mode] += (1 - loss) * experiment.noise.link**2 * per_link
        noise[mode] += experiment.noise.broadcast**2 * ((1 - loss) ** 2 * a @ a.T + loss * (1 - loss) * per_link)
    lost = loss * coupling
    mean = weights - lost
    mean[:, range(agents), range(agents)] += lost.sum(axis=2)
    return StepModel(
        links=links,
        weights=mean,
        nominal=weights,
        offsets=offsets,
        noise_gain=gain,
        noise=noise,
        delay=experiment.noise.delay,
        loss=loss,
        loss_variance=loss * (1 - loss) * coupling**2,
        chain=experiment.chain,
        initial=first_graph(experiment),
        grounded=grounded,
        reference=reference,
        dt=dt,
    )


def _built_in(experiment: Experiment, expm: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """(n, m, m): W_g of the law that the agents have by themselves, with its leaders."""
    gains, agents = experiment.leader_gains, experiment.agents
    grounded = np.isinf(gains)
    follows = ~grounded
    weights = np.zeros((len(experiment.graph_list), agents, agents))
    for mode, graph in enumerate(experiment.graph_list):
        z = graph.laplacian + np.diag(np.where(grounded, 0.0, gains))
        if experiment.time == "continuous":
            weights[mode] = np.eye(agents) - experiment.step_length * z
            weights[mode, grounded] = 0.0
        else:
            # The limit of exp(-(L + K)) for gains to infinity: leaders forget, followers no longer hear them.
            block = np.ix_(follows, follows)
            weights[mode][block] = expm(-z[block])
    return weights


def first_graph(experiment: Experiment) -> FloatArray:
    """(n,): the law of g(0).

    Parameters
    ----------
    experiment
        of which the file says how it begins
    """
    first = experiment.switching.initial
    if first == "stationary":
        return experiment.chain.stationary
    return np.array([float(graph.name == first) for graph in experiment.graph_list])


def _arcs(experiment: Experiment) -> BoolArray:
    """(n, m, m): whether agent i hears agent j, as the graphs say."""
    return np.array([graph.adjacency != 0.0 for graph in experiment.graph_list])
