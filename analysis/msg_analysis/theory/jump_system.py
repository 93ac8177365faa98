# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Reduced Markov jump linear systems: the coordinates in which second moments stay finite, and their components.

Sections 3.1 (consensus) and 3.2 (tracking) of the paper, its Appendix I in discrete time; for the steps of a run,
docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.sparse.csgraph

from msg_analysis.common.arrays import FloatArray, IntArray, once
from msg_analysis.experiment.markov_chain import Time
from msg_analysis.theory.message_steps import LossEvents, message_steps, whole_link_events

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.model.step_model import StepModel


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """What a system of the agents and what they heard has beside the agents; see ``message_steps``."""

    graphs: IntArray  # (n,) graph of every mode: with losses in bursts, modes are graphs and states of the channels
    origins: IntArray  # (k, 3) of every number s, see ``MessageSteps``


@dataclass(frozen=True, slots=True, eq=False)
class JumpSystem:
    """A jump linear system in reduced coordinates y of dimension d, with s - (what s should be) = lift @ y.

    s are the states x of the m agents. With values that are D steps old, it is x(k), x(k - 1), ..., x(k - D) stacked,
    m (D + 1) numbers, and x - (what x should be) = output @ y.

    Discrete: y(k+1) = W_g(k) y(k) + noise, then g jumps with P (eq. 19 of the paper). Continuous: dy = -Z_g y dt + F
    dW, g jumps with Gamma (eq. 4).
    """

    time: Time
    matrices: FloatArray  # (n, d, d) Z_i [1 / unit of time] or W_i
    noise: FloatArray  # (n, d, d) covariance of the noise, Q_i per unit of time or N_i per step
    chain: FloatArray  # (n, n) Gamma or P
    stationary: FloatArray  # (n,) pi
    lift: FloatArray  # (k, d) for k numbers s, columns orthonormal, so that y = lift^T (s - what s should be)
    loss_variance: FloatArray | None = None  # (n, k, k), see ``StepModel.loss_variance``; discrete time only
    readout: FloatArray | None = None  # (m, d) with a delay; None without, where ``lift`` has this role
    unreduced: FloatArray | None = None  # (n, k, k) in consensus: the same for the numbers s, whose zeros are exact
    losses: LossEvents | None = None  # with messages one by one, in place of ``loss_variance``
    unreduced_losses: LossEvents | None = None  # in consensus: the same for the numbers s
    messages: Messages | None = None  # with messages one by one
    step: StepModel | None = None  # of a run, from which its first steps follow

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return int(self.matrices.shape[0])

    @property
    def dimension(self) -> int:
        """Number of reduced coordinates d."""
        return int(self.lift.shape[1])

    @property
    def output(self) -> FloatArray:
        """(m, d): output @ y is the deviation of the agents from what they should be."""
        return self.lift if self.readout is None else self.readout

    @property
    def frame(self) -> FloatArray:
        """(m, f) columns orthonormal: coordinates of the deviations of the agents alone. ``lift`` where that is all."""
        if self.readout is None:
            return self.lift
        m = len(self.readout)
        return np.asarray(scipy.linalg.helmert(m).T if self.unreduced is not None else np.eye(m))

    def framed(self, moments: FloatArray) -> FloatArray:
        """(..., f, f) second moments of the agents in ``frame``, from those of the reduced coordinates (..., d, d)."""
        if self.readout is None:
            return moments
        return np.asarray(self.frame.T @ self.lifted(moments) @ self.frame)

    def lifted(self, moments: FloatArray) -> FloatArray:
        """(..., m, m) second moments of the agents from those of the reduced coordinates, (..., d, d)."""
        return np.asarray(self.output @ moments @ self.output.T)

    def reduced(self, deviations: FloatArray) -> FloatArray:
        """(..., d) reduced coordinates of the deviations of the agents (..., m); in consensus, of their states."""
        # With a delay, the earlier states are taken to be the same; so is what was heard, without its noise.
        if self.messages is not None:
            return np.asarray(deviations[..., self.messages.origins[:, 2]] @ self.lift)
        lift = self.lift.reshape(-1, deviations.shape[-1], self.dimension).sum(axis=0)
        return np.asarray(deviations @ lift)

    @property
    def lossy(self) -> bool:
        """Whether lost messages make the second moments more than W C W^T + N."""
        return self.loss_variance is not None or self.losses is not None

    def lost(self, moments: FloatArray) -> FloatArray:
        """(..., n, d, d): what lost messages add to W C W^T, for symmetric moments C (..., n, d, d).

        Without kept values, sum_ij variance_ij <(e_i - e_j)(e_i - e_j)^T, C> e_i e_i^T.
        """
        if self.losses is not None:
            return self.losses.lost(moments)
        assert self.loss_variance is not None
        full = self.lift @ moments @ self.lift.T
        own = np.diagonal(full, axis1=-2, axis2=-1)
        squares = own[..., :, None] + own[..., None, :] - 2.0 * full
        spread = (self.loss_variance * squares).sum(axis=-1)
        return np.asarray(self.lift.T @ (spread[..., None] * self.lift))

    def lost_adjoint(self, forms: FloatArray) -> FloatArray:
        """(..., n, d, d): the adjoint of ``lost``, for symmetric forms Y: <e_i e_i^T, Y> (e_i - e_j)(e_i - e_j)^T."""
        if self.losses is not None:
            return self.losses.adjoint(forms)
        assert self.loss_variance is not None
        seen = self.loss_variance * ((self.lift @ forms) * self.lift).sum(axis=-1)[..., None]
        laplacian = -(seen + seen.swapaxes(-1, -2))
        laplacian += np.eye(len(self.lift)) * (seen.sum(axis=-1) + seen.sum(axis=-2))[..., None]
        return np.asarray(self.lift.T @ laplacian @ self.lift)

    def of_modes(self, law: FloatArray) -> FloatArray:
        """(n,) law of the modes from that of the graphs; channels are in their stationary state."""
        if self.messages is None:
            return law
        graphs = self.messages.graphs
        shares = np.bincount(graphs, self.stationary)
        return np.asarray(law[graphs] * self.stationary / shares[graphs])

    def by_graph(self, stack: FloatArray) -> FloatArray:
        """Sums over the modes of each graph of a stack (..., n, a, b)."""
        if self.messages is None or len(self.messages.graphs) == self.messages.graphs[-1] + 1:
            return stack
        first = np.flatnonzero(np.diff(self.messages.graphs, prepend=-1))
        return np.add.reduceat(stack, first, axis=-3)

    def propagate(self, moments: FloatArray) -> FloatArray:
        """(n, d, d): K_j[C_j] = E[W C_j W^T | mode j] for every mode. Discrete time."""
        after = self.matrices @ moments @ self.matrices.transpose(0, 2, 1)
        if self.lossy:
            after += self.lost(moments)
        return np.asarray(after)

    def advance(self, moments: FloatArray, law: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments C_i (n, d, d) and law (n,) of the graph one step later (Proposition 6 of the paper). Discrete time.

        C_i(k+1) = sum_j P_ji (K_j[C_j(k)] + pi_j(k) N_j): the noise enters before the jump.
        """
        after = self.propagate(moments) + law[:, None, None] * self.noise
        return (self.chain.T @ after.reshape(len(after), -1)).reshape(after.shape), law @ self.chain


def emulated(step: StepModel, problem: str) -> JumpSystem:
    """What the steps of a run do, exactly (docs/theory.md, "The law of the steps" and "Beyond the paper").

    "consensus": the disagreement, in a Helmert basis of the vectors whose entries sum to zero; exact for every W with
    W 1 = 1. "tracking": the deviation from the reference, all agents (a start may put grounded leaders elsewhere).

    With a delay the stacked states make the same kind of step, and W 1 = 1 holds for them. What drops out is one number
    common to all of them, not one for each x(k - s): the agents' mean moves, and this acts on agents of unequal degree,
    because they compare their own new values with old ones of others.
    """
    m, consensus = step.agents, problem == "consensus"
    whole = message_steps(step) if step.by_message else None
    weights, noise, loss_variance = step.weights, step.noise, step.loss_variance
    if whole:
        weights, noise = whole.matrices, whole.noise
    elif step.delay:
        size = m * (step.delay + 1)
        own, old = slice(m), slice(size - m, size)
        inner = weights * np.eye(m)
        weights, noise, loss_variance = (np.zeros((step.modes, size, size)) for _ in range(3))
        weights[:, own, own] = inner
        weights[:, own, old] = step.weights - inner
        weights[:, m:, :-m] = np.eye(size - m)
        noise[:, own, own] = step.noise
        loss_variance[:, own, old] = step.loss_variance
    lift = scipy.linalg.helmert(weights.shape[1]).T if consensus else np.eye(weights.shape[1])
    losses = whole.losses if whole else whole_link_events(step) if step.whole_link else None
    return JumpSystem(
        time="discrete",
        matrices=lift.T @ weights @ lift,
        noise=_reduced_noise(noise, lift),
        chain=whole.chain if whole else step.transition,
        stationary=whole.stationary if whole else step.stationary,
        lift=lift,
        loss_variance=loss_variance if step.loss and losses is None and not whole else None,
        readout=lift[:m] - (lift[:m].mean(axis=0) if consensus else 0.0) if whole or step.delay else None,
        unreduced=weights if consensus else None,
        losses=losses and losses.projected(lift),
        unreduced_losses=losses if consensus else None,
        messages=Messages(whole.graphs, whole.origins) if whole else None,
        step=step,
    )


def continuous(experiment: Experiment) -> JumpSystem:
    """The paper's continuous-time system (Sections 3.1 and 3.2), without noise on the air, loss, delay or protocol.

    Leaders of infinite gain are the exact limit: their rows and columns are deleted, ``lift`` puts the zeros back.
    """
    gains = experiment.leader_gains
    follows = np.isfinite(gains)
    m = experiment.agents
    consensus = experiment.problem == "consensus"
    lift = scipy.linalg.helmert(m).T if consensus else np.eye(m)[:, follows]
    drift = np.stack([g.laplacian for g in experiment.graph_list]) + np.diag(np.where(follows, gains, 0.0))
    gain = experiment.noise_gain
    return JumpSystem(
        time="continuous",
        matrices=lift.T @ drift @ lift,
        noise=_reduced_noise(gain @ gain.transpose(0, 2, 1), lift),
        chain=experiment.chain.matrix,
        stationary=experiment.switching_law.stationary,
        lift=lift,
        unreduced=drift if consensus else None,
    )


def held(system: JumpSystem, mode: int) -> JumpSystem:
    """The same system, in continuous or discrete time, with one graph (``mode``, from 0) held fixed."""
    chain = np.zeros((1, 1)) if system.time == "continuous" else np.ones((1, 1))
    return part(system, np.array([mode]), chain, np.ones(1), np.zeros(1, np.int64))


def part(
    system: JumpSystem, modes: IntArray, chain: FloatArray, stationary: FloatArray, graphs: IntArray
) -> JumpSystem:
    """The same system with these of its modes, between which another chain switches; ``graphs``: see ``Messages``."""
    return replace(
        system,
        matrices=system.matrices[modes],
        noise=system.noise[modes],
        chain=chain,
        stationary=stationary,
        loss_variance=None if system.loss_variance is None else system.loss_variance[modes],
        unreduced=None if system.unreduced is None else system.unreduced[modes],
        losses=system.losses and system.losses.of_modes(modes),
        unreduced_losses=system.unreduced_losses and system.unreduced_losses.of_modes(modes),
        messages=system.messages and replace(system.messages, graphs=graphs),
    )


def _reduced_noise(noise: FloatArray, lift: FloatArray) -> FloatArray:
    """lift^T N lift for every mode, without what rounding leaves of noise that is common to all agents."""
    shape = len(noise), *(2 * lift.shape[1:])
    noise = once(noise)
    reduced = lift.T @ noise @ lift
    rounding = len(lift) * np.finfo(float).eps * np.abs(noise).max(axis=(1, 2), keepdims=True)
    common = np.abs(reduced).max(axis=(1, 2), keepdims=True, initial=0.0) <= rounding
    return np.broadcast_to(np.where(common, 0.0, reduced), shape)


CHANGE = 1e-12  # relative size of the changes that show how sensitive a rate is


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """A strongly connected component: some of the numbers of a system, and how they act on each other."""

    # In the order of the components the matrices of all graphs are block triangular at once, so the means decay as
    # slowly as those of the slowest component, and so do the second moments: the covariance of two components decays no
    # slower than the slower of the two (Cauchy and Schwarz). The eigenvalues of the whole say the same in exact
    # arithmetic only: a chain of agents is a Jordan block, whose eigenvalues rounding scatters.

    matrices: FloatArray  # (n, q, q) of Z_i or W_i
    consensus: bool  # whether only their disagreement decays: they hear nobody else, and there are no leaders
    lost: FloatArray | None  # (n, q, q + 1) loss variance; the last column is that of what comes from elsewhere
    losses: LossEvents | None = None  # with messages one by one, in place of ``lost``

    @property
    def normal(self) -> bool:
        """Whether the matrices are symmetric, so that rounding does little to the eigenvalues."""
        return bool(np.array_equal(self.matrices, self.matrices.transpose(0, 2, 1)))

    def system(self, of: JumpSystem) -> JumpSystem:
        """As a system of its own, without noise."""
        q = self.matrices.shape[1]
        inner = scipy.linalg.helmert(q).T if self.consensus else np.eye(q)
        variance = None
        if self.lost is not None:
            variance = np.concatenate([self.lost, np.zeros((len(self.lost), 1, q + 1))], axis=1)
        d = inner.shape[1]
        return JumpSystem(
            time=of.time,
            matrices=inner.T @ self.matrices @ inner,
            noise=np.zeros((of.modes, d, d)),
            chain=of.chain,
            stationary=of.stationary,
            lift=inner if variance is None else np.vstack([inner, np.zeros((1, d))]),
            loss_variance=variance,
            losses=self.losses and self.losses.projected(inner),
        )

    def changed(self, rng: np.random.Generator) -> Component:
        """With what each hears from others a little louder or softer, and its sum kept."""
        q = self.matrices.shape[1]
        change = self.matrices * (1.0 - np.eye(q)) * rng.uniform(-CHANGE, CHANGE, (q, q))
        change -= np.eye(q) * change.sum(axis=2)[:, :, None]
        return replace(self, matrices=self.matrices + change)


def components(system: JumpSystem) -> list[Component]:
    """The components that decay at all, of all graphs together."""
    consensus = system.unreduced is not None
    matrices = system.matrices if system.unreduced is None else system.unreduced
    hears = (matrices != 0.0).any(axis=0)
    variance = system.loss_variance
    if variance is not None:
        hears |= (variance != 0.0).any(axis=0)
    losses = system.unreduced_losses if consensus else system.losses
    if losses is not None:
        hears |= losses.uses()
    count, labels = scipy.sparse.csgraph.connected_components(hears, connection="strong")
    found = []
    for label in range(count):
        inside, outside = np.flatnonzero(labels == label), np.flatnonzero(labels != label)
        alone = consensus and not hears[np.ix_(inside, outside)].any()
        if alone and len(inside) == 1:
            continue  # what all the others agree on
        lost = None
        if variance is not None:
            from_outside = variance[:, inside][:, :, outside].sum(axis=2, keepdims=True)
            lost = np.concatenate([variance[:, inside][:, :, inside], from_outside], axis=2)
        events = losses and losses.projected(np.eye(len(labels))[:, inside])
        found.append(Component(matrices[:, inside][:, :, inside], alone, lost, events))
    return found
