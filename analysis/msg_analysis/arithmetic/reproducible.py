# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that are the same to the last bit on every machine: times of steps, random numbers, the matrix exponential.

Random streams need no communication: the key of a counter-based Philox generator comes from the seed, its counter from
stream, agent and block of steps. So any process can compute any agent's noise at any step, a restarted agent draws the
same numbers again, and one more agent does not change the streams of the others.
"""

from __future__ import annotations

import math
import threading
from enum import IntEnum
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from msg_analysis.common.arrays import FloatArray, IntArray

SECOND = 1_000_000_000  # ns
_LARGEST = 2**63 - 1


class StepClock:
    """Simulated time of the steps in whole nanoseconds, without rounding drift."""

    # Step k is due at (k + phase) dt, phase in [0, 1): k dt to the nearest nanosecond (half up), plus phase dt rounded
    # once. dt, in units of simulated time written as seconds, counts as its decimal text: 0.1 is one tenth.

    def __init__(self, dt: float, phase: float = 0.0) -> None:
        step = Fraction(repr(float(dt))) * SECOND
        self._numerator, self._denominator = step.numerator, step.denominator
        self.step_ns = float(step)  # dt [ns]
        self._shift = round(float(phase) * self.step_ns)

    def nanoseconds(self, step: int) -> int:
        """Time of a step [ns]."""
        if self._denominator == 1:
            return step * self._numerator + self._shift
        return (2 * step * self._numerator + self._denominator) // (2 * self._denominator) + self._shift

    def times(self, steps: IntArray) -> IntArray:
        """Times of steps of any shape [ns], in the same shape; equal to ``nanoseconds`` of each."""
        whole, rest = divmod(self._numerator, self._denominator)
        if 2 * int(np.max(steps, initial=0)) * rest + self._denominator > _LARGEST:  # a dt of very many digits
            flat = [self.nanoseconds(step) for step in np.ravel(steps).tolist()]
            return np.array(flat, dtype=np.int64).reshape(np.shape(steps))
        parts = (2 * steps * rest + self._denominator) // (2 * self._denominator)
        return np.asarray(steps * whole + parts + self._shift, dtype=np.int64)


STEPS_PER_BLOCK = 256  # whose noise is drawn at once; part of the definition of a run: another one gives other numbers


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
    """The generator of one block of a stream, of an agent (from 0; 0 where there is none) or a ``link_number``."""
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
    """As ``generator``, valid until the next call in this thread: to make a new one takes 12 us."""
    try:
        own: np.random.Generator = _reused.generator
    except AttributeError:
        own = _reused.generator = np.random.Generator(np.random.Philox(key=0))
    own.bit_generator.state = {
        "bit_generator": "Philox",
        "state": {"key": _key(seed), "counter": _counter(stream, agent, block)},
        "buffer": np.zeros(4, dtype=np.uint64),
        "buffer_pos": 4,  # nothing left in it
        "has_uint32": 0,
        "uinteger": 0,
    }
    return own


_reused = threading.local()  # ``generator`` of each thread


SLICES = 3
TERMS = 13  # of the Taylor series, at a norm of at most 1/8: the next one is below 1e-22


def exponential(matrix: FloatArray) -> FloatArray:
    """(m, m) exp(A) by scaling and squaring of exp(A) - I, which keeps the accuracy of small entries."""
    # That of the libraries differs between processors, because the order of the sums in a matrix product does.
    norm = float(np.abs(matrix).sum(axis=1).max(initial=0.0))
    squarings = max(0, math.frexp(norm)[1] + 3)
    scaled = matrix * 2.0**-squarings
    less_one = term = scaled
    for k in range(2, TERMS + 1):
        term = reproducible_product(term, scaled) / k
        less_one = less_one + term
    for _ in range(squarings):
        less_one = 2.0 * less_one + reproducible_product(less_one, less_one)
    return np.asarray(np.eye(len(matrix)) + less_one)


def reproducible_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(m, m) A B, the same on every processor; its error is about 1e-16 of the largest entries of A and B."""
    # Products of slices of few bits have sums that are exact in any order (Ozaki, Ogita, Oishi and Rump 2012).
    bits = (53 - math.frexp(len(a))[1]) // 2
    left, right = _slices(a, bits), _slices(b, bits)
    total = np.zeros(a.shape)
    for depth in range(SLICES - 1, -1, -1):  # small ones first
        for i in range(depth + 1):
            total += left[i] @ right[depth - i]  # every sum in it is exact
    return total


def _slices(matrix: FloatArray, bits: int) -> list[FloatArray]:
    """The matrix as a sum of matrices of whole multiples of 2^-bits, 2^-2bits, ... of its largest entry."""
    unit = 2.0 ** math.frexp(float(np.abs(matrix).max(initial=0.0)))[1]
    slices, rest = [], matrix
    for _ in range(SLICES):
        unit *= 2.0**-bits
        slices.append(np.rint(rest / unit) * unit)
        rest = rest - slices[-1]
    return slices
