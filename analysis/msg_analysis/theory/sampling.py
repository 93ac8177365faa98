# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Steady errors by sampling, where matrices are too large: unbiased, with an interval.

With g(-1), g(-2), ... a stationary path of the graphs backwards, and random z with E[z z^T] = I (projected: consensus),

    E = sum_(k >= 1) E |B_g(-k)^T W_g(1-k)^T ... W_g(-1)^T z|^2

so one walk of z through transposed sparse steps is one sample. Messages are walked through backwards, too: what an
agent used of a message goes to the message, and from there, squared with its noise, to the sender. A walk whose latest
terms are small ends by Russian roulette: one that survives with probability p counts 1 / p, so no tail is cut off.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import count as numbers_from
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.special

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.resources import few_blas_threads, tell
from msg_analysis.common.text import agent_text, finite, markdown_table, number_text
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment.limits import dense_links
from msg_analysis.experiment.links import expanded
from msg_analysis.experiment.markov_chain import Schedule
from msg_analysis.model.step_model import build_run_model, step_law
from msg_analysis.theory.jump_system import emulated, part
from msg_analysis.theory.sparse_walks import Law, Walk

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

LEVEL = 0.95
ALL_AGENTS = 20  # most agents of which each has walks of its own by default
FEWEST = 32  # samples before an interval is believed
NUMBERS = 2**17  # on arcs, that walks which are made together have at a time: they fit in a cache
LEAST_TOGETHER, MOST_TOGETHER = 4, 512
BLOCK = 16  # steps of a walk before it may end, and twice the delay; later a quarter of those that it has made
SMALL = 0.03  # of the sum so far, terms of a block: then the walk may end
NOTHING = 1e-30  # of |z|^2, is rounding
SHORTEST, SETTLED = 128, 1e-12  # steps that are drawn at first; of |z|^2, with matrices, is the end
GROWTH = 1e6  # of |z|^2, beyond what weights that are not negative can do: the steps are unstable
UNSTABLE = (
    "second moments: a walk backwards through the steps has grown a million times: the steps are unstable, there is no "
    "steady state: lower run.dt"
)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SampledPrediction:
    """The steady errors of the run's steps, sampled.

    Attributes
    ----------
    experiment
        what is predicted
    system_error, interval
        E, and its 95 % interval (t, over independent samples)
    node_errors, node_intervals
        (m,) E_i and (m, 2) their 95 % intervals; nan for agents that were not sampled
    paths
        number of walks, each on a path of the graphs of its own
    seed
        from which they were drawn
    seconds
        that they took [s]
    """

    experiment: Experiment
    system_error: float
    interval: tuple[float, float]
    node_errors: FloatArray
    node_intervals: FloatArray
    paths: int
    seed: int
    seconds: float

    def __repr__(self) -> str:
        low, high = self.interval
        text = f"system error {self.system_error:.6g}, 95 % interval {low:.6g} to {high:.6g}, {self.paths} samples"
        return f"<SampledPrediction of {self.experiment.name!r}: {text}>"

    def _repr_markdown_(self) -> str:
        rows = [("**system**", number_text(self.system_error), *map(number_text, self.interval))]
        for i in np.flatnonzero(~np.isnan(self.node_errors)).tolist():
            numbers = self.node_errors[i], *self.node_intervals[i]
            rows.append((agent_text(i + 1, self.experiment.names), *map(number_text, numbers)))
        return "Sampled errors, steady state\n\n" + markdown_table(("", "mean-square error", "from", "to (95 %)"), rows)

    def to_json(self) -> dict[str, Any]:
        """The document of ``msg-analysis predict --json``, with None for what is not sampled."""
        error, nodes = self.system_error, self.node_errors
        law = {
            "law": step_law(self.experiment),
            "method": "sampled",
            "system_error": error,
            "interval": list(self.interval),
            "node_errors": finite(nodes.tolist()),
            "node_intervals": finite(self.node_intervals.tolist()),
            "system_certainty": 1.0 / error if error > 0.0 else None,
            "node_certainty": [1.0 / node if node > 0.0 else None for node in nodes.tolist()],
            "covariance": None,
            "paths": self.paths,
            "seed": self.seed,
            "seconds": self.seconds,
        }
        document: dict[str, Any] = {
            "agents": self.experiment.agents,
            "names": self.experiment.names,
            "modes": [graph.name for graph in self.experiment.written_graphs],
            "stationary": [1.0] if self.experiment.links else self.experiment.switching_law.stationary.tolist(),
        }
        laws = {"discrete": law} if self.experiment.time == "discrete" else {"continuous": None, "emulated": law}
        tails = dict.fromkeys(("radius", "lower", "upper", "finite"))
        rest = {"static": None, "disconnected": [], "fourth_moment": tails, "notes": list(self.experiment.notes)}
        return document | laws | rest


def sampled_prediction(
    experiment: Experiment,
    *,
    precision: float = 0.01,
    within: float = 60.0,
    agents: Sequence[int | str] = (),
    seed: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> SampledPrediction:
    """Sample the steady errors of the run's steps.

    Parameters
    ----------
    experiment
        with a chain, or links that switch by themselves
    precision
        half width of the 95 % intervals at which sampling ends, relative to the error; above 0, below 1
    within
        time after which it ends all the same [s]
    agents
        whose errors are sampled, too, by number from 1 or name; with up to 20 agents, by default all
    seed
        of the random numbers, >= 0; for one seed, time and workers decide nothing but how many samples there are.
        None: ``run.seed``
    workers
        processes of this machine that make the samples; None: this one
    scheduler
        address of a Dask scheduler, whose workers make them

    Raises
    ------
    InputError
        an argument that is not valid, a given sequence of graphs, unstable steps, too little time for an interval, or
        workers that are not there
    """
    began = time.monotonic()
    for key, value, most in (("precision", precision, 1.0), ("within", within, math.inf)):
        if not 0.0 < value < most:
            wanted = "expected a number above 0" + ", below 1" * (most < math.inf)
            raise InputError(f"{key}: {value:g}: {wanted}: for example 0.01")
    seed = experiment.run.seed if seed is None else seed
    dense, m = dense_links(experiment), experiment.agents
    every = not agents and m <= ALL_AGENTS
    units = list(range(m)) if every else experiment.indices(agents)
    width = len(units) + (not every)
    make: Callable[[int, Callable[[], bool]], FloatArray | None]
    if dense:
        if experiment.noise.burst is not None:
            wanted = "expected the built-in law in continuous time, or no noise.burst: no sampling here"
            raise NotAvailableError(f"switching.links, noise.activation: {wanted}")
        make, width = partial(_of_path, experiment, units, seed, time.time() + within), 1
    else:
        law = Law(experiment if experiment.links else expanded(experiment))
        rounds = max(1, min(MOST_TOGETHER, max(LEAST_TOGETHER, NUMBERS // max(1, len(law.targets)))) // width)
        make = partial(_batch, law, units, every, rounds, seed, time.time() + within)
    count, sums, squares = 0, np.zeros(1 + len(units)), np.zeros(1 + len(units))
    mean = half = sums
    batches = (make(number, lambda: False) for number in numbers_from())
    if workers or scheduler:
        from msg_analysis.sweeps.workers import in_order

        batches = in_order(make, workers, scheduler)
    with closing(batches):
        for batch in batches:
            if batch is None:
                break
            sums, squares, count = sums + batch.sum(axis=0), squares + (batch**2).sum(axis=0), count + len(batch)
            mean = sums / count
            variance = np.maximum(squares / count - mean**2, 0.0) / max(1, count - 1)
            half = scipy.special.stdtrit(max(1, count - 1), 0.5 + LEVEL / 2.0) * np.sqrt(variance)
            share = precision * mean[0] / half[0] if half[0] else 1.0
            tell("samples", count, max(count, math.ceil(count / min(1.0, share) ** 2)))
            if count >= FEWEST and (half <= precision * mean)[: None if agents else 1].all():
                break
    if count < 2:
        wanted = "expected time for two samples at least, each of which ends when the agents have forgotten its start"
        raise InputError(f"within: {within:g} s: {wanted}: raise it")
    nodes, intervals = np.full(m, np.nan), np.full((m, 2), np.nan)
    nodes[units], intervals[units] = mean[1:], np.stack([mean - half, mean + half], axis=1)[1:]
    return SampledPrediction(
        experiment,
        system_error=float(mean[0]),
        interval=(float(mean[0] - half[0]), float(mean[0] + half[0])),
        node_errors=nodes,
        node_intervals=intervals,
        paths=count * width,
        seed=seed,
        seconds=time.monotonic() - began,
    )


@few_blas_threads
def _of_path(
    experiment: Experiment, units: Sequence[int], seed: int, until: float, batch: int, stopping: Callable[[], bool]
) -> FloatArray | None:
    """(1, 1 + units): the same given one path, by matrices of its graphs: forms Y go backwards, of all agents at once.

    With a step y(k+1) = A y(k) + noise of covariance N, and losses: <N, Y> is a term of the sum, and Y becomes
    A^T Y A and the adjoint of the losses.
    """
    # The chains of the links are reversible: a path has the same law backwards.
    of_path = int(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(batch,))).integers(2**53))
    done, steps, first = 0, SHORTEST, math.inf
    total, forms = np.zeros(1 + len(units)), np.empty(0)
    while not forms.size or forms[0].trace() > SETTLED * first:
        if forms.size and not forms[0].trace() <= GROWTH * experiment.agents * first:
            raise InputError(UNSTABLE)
        if time.time() > until or stopping():
            return None
        drawn = experiment.with_run(seed=of_path, duration=steps * experiment.step_length)  # a longer one begins alike
        path = drawn.switching_law
        assert isinstance(path, Schedule)
        system = emulated(build_run_model(drawn), drawn.problem)
        if not forms.size:
            rows = system.output[units]
            forms = np.concatenate([[system.output.T @ system.output], rows[:, :, None] * rows[:, None]])
            first = float(forms[0].trace())
        one = np.ones((1, 1)), np.ones(1), np.zeros(1, np.int64)
        alone = [part(system, np.array([mode]), *one) for mode in range(system.modes)]
        for mode in path.sampled(steps, drawn.step_length)[done:].tolist():
            step = alone[mode]
            total += (forms * step.noise).sum(axis=(1, 2))
            lost = step.lost_adjoint(forms[:, None])[:, 0] if step.lossy else 0.0
            forms = step.matrices[0].T @ forms @ step.matrices[0] + lost
        done, steps = steps, 2 * steps
    return total[None]


def _batch(
    law: Law,
    units: Sequence[int],
    every: bool,
    rounds: int,
    seed: int,
    until: float,  # of the clock that all hosts have
    batch: int,
    stopping: Callable[[], bool],
) -> FloatArray | None:
    """(rounds, 1 + units) independent samples of the system error and of those of agents; None: not done in time."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(batch,)))
    m, width = law.agents, len(units) + (not every)
    z: FloatArray = np.zeros((m, rounds, width))
    z[units, :, np.arange(width - len(units), width)] = 1.0
    if not every:
        z[:, :, 0] = 2.0 * rng.integers(0, 2, (m, rounds)) - 1.0
    if law.consensus:
        z -= z.mean(axis=0)
    walk, first = Walk(law, z.reshape(m, -1), rng), np.einsum("irw,irw->rw", z, z).ravel()
    total, counts, number = np.zeros(rounds * width), np.ones(rounds * width), np.arange(rounds * width)
    with np.errstate(over="ignore", invalid="ignore"):
        while number.size:
            steps = max(BLOCK + 2 * law.delay, walk.steps // 4)
            found = walk.block(steps, lambda: time.time() > until or stopping())
            if found is None:
                return None
            terms, size = found
            if not (size <= GROWTH * m * first[number]).all():
                raise InputError(UNSTABLE)
            total[number] += counts * terms
            # Where this graph has no noise, or not where z is, terms that are zero are not the last ones.
            ahead = counts * np.maximum(terms, law.noise * size * steps)
            chance = np.divide(ahead, SMALL * total[number], out=np.ones(len(number)), where=total[number] > 0.0)
            lives = (rng.random(len(number)) < chance) & (size > NOTHING * first[number])
            counts = (counts / np.clip(chance, np.finfo(float).tiny, 1.0))[lives]
            number = number[lives]
            walk.keep(lives)
    table = total.reshape(rounds, width)
    return np.concatenate([table.sum(axis=1, keepdims=True), table], axis=1) if every else table
