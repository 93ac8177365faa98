"""Reduced Markov jump linear systems: the states in which second moments stay finite."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from msg_analysis.model.chain import Time
from msg_analysis.types import FloatArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment import Experiment
    from msg_analysis.model.step import StepModel


@dataclass(frozen=True, slots=True, eq=False)
class JumpSystem:
    """A jump linear system in reduced coordinates y of dimension d, with x - (what x should be) = lift @ y.

    Discrete: y(k+1) = W_g(k) y(k) + noise, then g jumps with P. Continuous: dy = -Z_g y dt + F dW, g jumps
    with Gamma.

    Attributes
    ----------
    time : "continuous" or "discrete"
    matrices : (n, d, d) Z_i [1 / unit of time] or W_i
    noise : (n, d, d) covariance of the noise, per unit of time or per step
    chain : (n, n) Gamma or P
    stationary : (n,) pi
    lift : (m, d), columns orthonormal, so that y = lift^T (x - what x should be)
    loss_variance : (n, m, m) or None; see ``StepModel.loss_variance``. Discrete time only
    """

    time: Time
    matrices: FloatArray
    noise: FloatArray
    chain: FloatArray
    stationary: FloatArray
    lift: FloatArray
    loss_variance: FloatArray | None = None

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return int(self.matrices.shape[0])

    @property
    def dimension(self) -> int:
        """Number of reduced coordinates d."""
        return int(self.lift.shape[1])

    def lifted(self, moments: FloatArray) -> FloatArray:
        """(..., m, m) of (..., d, d): second moments of the agents from those of the reduced coordinates."""
        return np.asarray(self.lift @ moments @ self.lift.T)

    def reduced(self, deviations: FloatArray) -> FloatArray:
        """(..., d) of (..., m): reduced coordinates of deviations; in consensus, of the states."""
        return np.asarray(deviations @ self.lift)

    def propagate(self, moments: FloatArray) -> FloatArray:
        """(n, d, d): K_j[C_j] = E[W C_j W^T | mode j] for every mode. Discrete time."""
        after = self.matrices @ moments @ self.matrices.transpose(0, 2, 1)
        if self.loss_variance is not None:
            full = self.lifted(moments)
            own = np.diagonal(full, axis1=1, axis2=2)
            squares = own[:, :, None] + own[:, None, :] - full - full.transpose(0, 2, 1)
            spread = (self.loss_variance * squares).sum(axis=2)
            after += np.einsum("ia,ni,ib->nab", self.lift, spread, self.lift)
        return np.asarray(after)

    def advance(self, moments: FloatArray, law: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One step of the second moments and of the law of the graph. Discrete time.

        C_i(k+1) = sum_j P_ji (K_j[C_j(k)] + pi_j(k) N_j); note that the noise enters before the jump.

        Parameters
        ----------
        moments : (n, d, d) C_i(k) = E[y y^T; mode i]
        law : (n,) of g(k)
        """
        after = self.propagate(moments) + law[:, None, None] * self.noise
        return np.tensordot(self.chain, after, axes=(0, 0)), law @ self.chain


def emulated(step: StepModel, problem: str) -> JumpSystem:
    """What the steps of a run do, exactly.

    Consensus: the disagreement, in a Helmert basis of the vectors whose entries sum to zero. Exact for every
    W with W 1 = 1. Tracking: the deviation from the reference, all agents (a start may put grounded leaders
    elsewhere).

    Parameters
    ----------
    step : the compiled experiment
    problem : "consensus" or "tracking"
    """
    m = step.agents
    lift = scipy.linalg.helmert(m).T if problem == "consensus" else np.eye(m)
    return JumpSystem(
        time="discrete",
        matrices=lift.T @ step.weights @ lift,
        noise=lift.T @ step.noise @ lift,
        chain=step.transition,
        stationary=step.stationary,
        lift=lift,
        loss_variance=step.loss_variance if step.loss else None,
    )


def continuous(experiment: Experiment) -> JumpSystem:
    """The paper's continuous-time system (sections III and IV).

    Leaders of infinite gain are the exact limit: their rows and columns are deleted, ``lift`` puts the zeros
    back. Noise on the air and lost messages belong to steps; they have no place here.
    """
    gains = experiment.leader_gains
    follows = np.isfinite(gains)
    m = experiment.agents
    lift = scipy.linalg.helmert(m).T if experiment.problem == "consensus" else np.eye(m)[:, follows]
    drift = np.stack([g.laplacian for g in experiment.graph_list]) + np.diag(np.where(follows, gains, 0.0))
    noise = lift.T @ experiment.noise_gain @ experiment.noise_gain.T @ lift
    return JumpSystem(
        time="continuous",
        matrices=lift.T @ drift @ lift,
        noise=np.broadcast_to(noise, (len(drift), *noise.shape)).copy(),
        chain=experiment.chain.matrix,
        stationary=experiment.chain.stationary,
        lift=lift,
    )


def held(system: JumpSystem, mode: int) -> JumpSystem:
    """The same system with one graph held for ever."""
    return JumpSystem(
        time=system.time,
        matrices=system.matrices[mode : mode + 1],
        noise=system.noise[mode : mode + 1],
        chain=np.zeros((1, 1)) if system.time == "continuous" else np.ones((1, 1)),
        stationary=np.ones(1),
        lift=system.lift,
        loss_variance=None if system.loss_variance is None else system.loss_variance[mode : mode + 1],
    )
