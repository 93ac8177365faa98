"""The graph path of a run: which graph each step uses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.model.arithmetic.random_streams import Stream, generator
from msg_analysis.types import FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.experiment import Experiment


@dataclass(frozen=True, slots=True)
class Sojourn:
    """A stretch of steps with one graph.

    Attributes
    ----------
    sequence
        number of the sojourn from 0
    mode
        index of the graph from 0
    first_step, last_step
        the steps k -> k+1 with first_step <= k <= last_step use it
    """

    sequence: int
    mode: int
    first_step: int
    last_step: int


def sojourns(experiment: Experiment, initial: FloatArray) -> Iterator[Sojourn]:
    """The graph path of a run of N steps, drawn from the experiment's seed.

    Step k uses the graph that the chain is in at time k dt, so the graphs of successive steps are a Markov chain with
    P = expm(Gamma dt), exactly. A sojourn between two sampling times, which no step sees, is left out.

    Parameters
    ----------
    experiment
        whose chain, seed and duration
    initial
        (n,) law of g(0)
    """
    steps = experiment.steps
    time = 0.0
    first = 0
    sequence = 0
    for mode, held in experiment.chain.sojourns(initial, generator(experiment.run.seed, Stream.SWITCHING)):
        time += held
        end = steps if math.isinf(time) else min(steps, math.ceil(time / experiment.step_length))
        if end > first:
            yield Sojourn(sequence, mode, first, end - 1)
            sequence += 1
            first = end
        if end >= steps:
            return


def mode_path(experiment: Experiment, initial: FloatArray) -> IntArray:
    """(N,) index of the graph of each step k -> k+1.

    Parameters
    ----------
    experiment
        whose chain, seed and duration
    initial
        (n,) law of g(0)
    """
    modes = np.empty(experiment.steps, dtype=np.int64)
    for sojourn in sojourns(experiment, initial):
        modes[sojourn.first_step : sojourn.last_step + 1] = sojourn.mode
    return modes
