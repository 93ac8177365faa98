"""Noise and loss on the air: what becomes of a value between the agent that publishes it and the one that uses it.

What agent i uses for its neighbour j in the step from x(k) is y_ij(k) = x_j(k) + b_j(k) + l_ij(k): b_j is broadcast
noise, in the value when it is published, the same for all who hear it; l_ij is link noise, added by the receiver. When
the message is lost there is no coupling in that step: x_i(k) takes the place of y_ij(k). A message carries all its
replicas, which are therefore lost together. An agent's own value is always the truth.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, generator, link_number, normals
from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.types import BoolArray, FloatArray

LOST = 2**64 - 1
"""In ``heard`` of a state message: the neighbour's message was lost. No step of a run has this number."""


class Air:
    """The random numbers of noise and loss on the air, block after block of steps.

    Like all others they are functions of the seed, the stream, who it is about, and the block of steps; they do not
    depend on the graph: what a link would do in a step is settled whether that step uses it or not.

    Parameters
    ----------
    experiment
        with its ``noise`` and ``run``
    """

    def __init__(self, experiment: Experiment) -> None:
        noise = experiment.noise
        self.broadcast, self.link, self.loss = noise.broadcast, noise.link, noise.loss
        self._seed = experiment.run.seed
        self._shape = (STEPS_PER_BLOCK, experiment.run.replicas)
        # A step and the one whose state is published after it may lie in two blocks.
        self._broadcast_block = lru_cache(maxsize=2)(self.broadcast_noise)

    def broadcast_noise(self, agent: int, block: int) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): b of an agent (index from 0).

        Parameters
        ----------
        agent
            index from 0
        block
            number of the block of steps, from 0
        """
        return self.broadcast * normals(self._seed, Stream.BROADCAST, agent, block, self._shape)

    def link_noise(self, receiver: int, sender: int, block: int) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): l of the messages from sender to receiver (indices from 0).

        Parameters
        ----------
        receiver
            index from 0
        sender
            index from 0
        block
            number of the block of steps, from 0
        """
        return self.link * normals(self._seed, Stream.LINK, link_number(receiver, sender), block, self._shape)

    def losses(self, receiver: int, sender: int, block: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost.

        Parameters
        ----------
        receiver
            index from 0
        sender
            index from 0
        block
            number of the block of steps, from 0
        """
        random = generator(self._seed, Stream.LOSS, link_number(receiver, sender), block)
        return random.random(STEPS_PER_BLOCK) < self.loss

    def published(self, agent: int, step: int, state: FloatArray) -> FloatArray:
        """(replicas,): what one agent publishes of its state of a step; for many steps in a row.

        Parameters
        ----------
        agent
            index from 0
        step
            k; the noise of a block is kept, so steps one after the other are fast
        state
            (replicas,) x(k) of the agent
        """
        block, within = divmod(step, STEPS_PER_BLOCK)
        return np.asarray(state + self._broadcast_block(agent, block)[within])
