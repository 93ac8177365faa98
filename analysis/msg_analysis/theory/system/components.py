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

"""The parts of a network of which none hears another in both directions: its strongly connected components.

In their order the matrices of all graphs are block triangular at once, so the means decay as slowly as those of the
slowest component, and so do the second moments: the covariance of two components decays no slower than the slower of
the two (Cauchy and Schwarz). The eigenvalues of the whole say the same in exact arithmetic only: a chain of agents is
a Jordan block, whose eigenvalues rounding scatters. See docs/theory.md, "Transients".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse.csgraph

from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.system.loss_events import LossEvents
from msg_analysis.types import BoolArray, FloatArray

CHANGE = 1e-12  # relative size of the changes that show how sensitive a rate is


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """Some of the numbers of a system, and how they act on each other."""

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
    return list(_found(matrices, variance, losses, hears, consensus=consensus))


def _found(
    matrices: FloatArray, variance: FloatArray | None, losses: LossEvents | None, hears: BoolArray, *, consensus: bool
) -> Iterator[Component]:
    count, labels = scipy.sparse.csgraph.connected_components(hears, connection="strong")
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
        yield Component(matrices[:, inside][:, :, inside], alone, lost, events)
