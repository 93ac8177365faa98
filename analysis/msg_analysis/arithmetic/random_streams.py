# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Random streams that need no communication.

Every number of a run is a function of (seed, stream, agent, block of steps): the key of a counter-based Philox
generator comes from the seed, its counter from the rest. So any process can compute any agent's noise at any step, a
restarted agent draws the same numbers again, and one more agent does not change the streams of the others.
"""

from __future__ import annotations

import threading
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from msg_analysis.common.arrays import FloatArray

STEPS_PER_BLOCK = 256
"""Steps whose noise is drawn at once. Part of the definition of a run: another value gives other numbers."""


class Stream(IntEnum):
    """What a random number is used for."""

    SWITCHING = 1
    START = 2
    PROCESS = 3
    BROADCAST = 4
    LINK = 5
    LOSS = 6
    PHASE = 7
    PAST = 8
    CHANNEL = 100  # packets between two hosts; all others are part of the run


def generator(seed: int, stream: Stream, agent: int = 0, block: int = 0) -> np.random.Generator:
    """The generator of one block of one agent's stream.

    ``agent`` counts from 0 (0 where the stream belongs to no agent), or is a ``link_number``. ``block`` is the step //
    STEPS_PER_BLOCK, negative for the steps before the start.
    """
    return np.random.Generator(np.random.Philox(key=_key(seed), counter=_counter(stream, agent, block)))


def _counter(stream: Stream, agent: int, block: int) -> NDArray[np.uint64]:
    return np.array([0, block % 2**64, agent, int(stream)], dtype=np.uint64)


@lru_cache(maxsize=16)
def _key(seed: int) -> NDArray[np.uint64]:
    key: NDArray[np.uint64] = np.random.SeedSequence(seed).generate_state(2, np.uint64).astype(np.uint64, copy=False)
    return key


def link_number(receiver: int, sender: int) -> int:
    """Number in place of the agent in the streams of a directed link, from sender to receiver (indices from 0)."""
    return receiver << 32 | sender


def normals(seed: int, stream: Stream, agent: int, block: int, shape: tuple[int, ...]) -> FloatArray:
    """Standard normal numbers of one block, of the given shape; other arguments as of ``generator``."""
    return _reused_generator(seed, stream, agent, block).standard_normal(shape)


def uniforms(seed: int, stream: Stream, agent: int, block: int, count: int) -> FloatArray:
    """(count,) numbers of one block, uniform from 0 to 1; other arguments as of ``generator``."""
    return _reused_generator(seed, stream, agent, block).random(count)


def _reused_generator(seed: int, stream: Stream, agent: int, block: int) -> np.random.Generator:
    """As ``generator``, valid until the next call in this thread."""
    own = _reused.generator
    own.bit_generator.state = {
        "bit_generator": "Philox",
        "state": {"key": _key(seed), "counter": _counter(stream, agent, block)},
        "buffer": np.zeros(4, dtype=np.uint64),
        "buffer_pos": 4,  # nothing left in it
        "has_uint32": 0,
        "uinteger": 0,
    }
    return own


class _Reused(threading.local):
    """A generator of each thread: to make a new one takes 12 us, most of them for a seed from the system."""

    def __init__(self) -> None:
        self.generator = np.random.Generator(np.random.Philox(key=0))


_reused = _Reused()
