"""What one step of a run does: the experiment compiled to a discrete-time Markov jump linear system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from msg_analysis.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment import Experiment


@dataclass(frozen=True, slots=True, eq=False)
class StepModel:
    """x(k+1) = W_g(k) x(k) + offset_g(k) + noise, then g jumps with P: "what the network actually does".

    Convention: the step k -> k+1 uses g(k). Modes and agents count from 0 here. With a delay d, the entries of W_g(k)
    off the diagonal take x(k - d) instead of x(k), and x(k) = x(0) before the start.

    Attributes
    ----------
    weights : (n, m, m) W_g with its mean over lost messages: where one is lost, its weight falls to the agent itself
    nominal : (n, m, m) W_g when nothing is lost: I - dt Z_g (continuous time, Euler) or exp(-Z_g) (discrete time); rows
        of grounded leaders are zero
    offsets : (n, m) what the reference adds, so that the reference is a fixed point
    noise_gain : (n, m, m) B_g: the process noise of a step is B_g v with v ~ N(0, I), the same v whatever g
    noise : (n, m, m) covariance N_g of all that is random in a step: B_g B_g^T plus noise on the air
    delay : age d, in steps, of the states of others that a step uses
    loss : probability that a directed message is ignored in a step. ``weights`` is the mean over it; the spread adds
        sum_ij variance_g[i, j] (x_i - x_j)^2 e_i e_i^T to the second moment (``loss_variance``)
    loss_variance : (n, m, m) p (1 - p) (nominal W_g)_ij^2 off the diagonal
    transition : (n, n) P
    stationary : (n,) pi
    initial : (n,) law of g(0)
    grounded : (m,) True for leaders of infinite gain
    reference : what tracking agents should hold; 0 for consensus
    dt : simulated time of a step
    """

    weights: FloatArray
    nominal: FloatArray
    offsets: FloatArray
    noise_gain: FloatArray
    noise: FloatArray
    delay: int
    loss: float
    loss_variance: FloatArray
    transition: FloatArray
    stationary: FloatArray
    initial: FloatArray
    grounded: BoolArray
    reference: float
    dt: float

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return int(self.weights.shape[0])

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return int(self.weights.shape[1])

    def inputs(self, mode: int, agent: int) -> IntArray:
        """Agents, ascending, whose states row ``agent`` of W_mode uses; the agent itself always among them."""
        used = self.nominal[mode, agent] != 0.0
        used[agent] = True
        return np.flatnonzero(used)

    def neighbours(self, mode: int, agent: int) -> IntArray:
        """The other agents, ascending, whose states row ``agent`` of W_mode uses."""
        used = self.inputs(mode, agent)
        return np.asarray(used[used != agent])

    @property
    def most_neighbours(self) -> int:
        """Largest number D of neighbours that any agent has in any graph."""
        return int((self.nominal != 0.0).sum(axis=2, where=~np.eye(self.agents, dtype=bool)).max())

    def listens(self) -> BoolArray:
        """(m, m): whether agent i uses the state of agent j != i in any graph."""
        used: BoolArray = (self.nominal != 0.0).any(axis=0)
        np.fill_diagonal(used, False)
        return used


def build_step_model(experiment: Experiment) -> StepModel:
    """Compile an experiment to what one of its steps does.

    One thread of linear algebra: the matrix exponential of a discrete-time experiment must come out the same, to the
    last bit, in every process of a run, whatever number of threads it was given.
    """
    graphs = experiment.graph_list
    agents = experiment.agents
    dt = experiment.step_length
    gains = experiment.leader_gains
    grounded = np.isinf(gains)
    follows = ~grounded
    finite_gains = np.where(grounded, 0.0, gains)
    weights = np.zeros((len(graphs), agents, agents))
    with threadpool_limits(1):
        for mode, graph in enumerate(graphs):
            z = graph.laplacian + np.diag(finite_gains)
            if experiment.time == "continuous":
                weights[mode] = np.eye(agents) - dt * z
                weights[mode, grounded] = 0.0
            else:
                # The limit of exp(-(L + K)) for gains to infinity: leaders forget, followers no longer hear them.
                block = np.ix_(follows, follows)
                weights[mode][block] = scipy.linalg.expm(-z[block])
        transition = experiment.chain.transition(dt)
    gain = np.sqrt(dt) * experiment.noise_gain
    if experiment.time == "continuous":
        gain[:, grounded] = 0.0  # a leader held at the reference has no noise either
    reference = experiment.reference
    offsets = reference * (1.0 - weights.sum(axis=2)) if reference else np.zeros((len(graphs), agents))

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
    stationary = experiment.chain.stationary
    initial = stationary.copy()
    if experiment.switching.initial != "stationary":
        initial = np.array([float(graph.name == experiment.switching.initial) for graph in graphs])
    return StepModel(
        weights=mean,
        nominal=weights,
        offsets=offsets,
        noise_gain=gain,
        noise=noise,
        delay=experiment.noise.delay,
        loss=loss,
        loss_variance=loss * (1 - loss) * coupling**2,
        transition=transition,
        stationary=stationary,
        initial=initial,
        grounded=grounded,
        reference=reference,
        dt=dt,
    )
