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

"""Which switching rates are wrong, and their estimates: maximum likelihood from the counted transitions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.statistics.distributions import chi2_quantile
from msg_analysis.inference.statistics.forward_selection import Candidate, select
from msg_analysis.model.network.markov_chain import MarkovChain
from msg_analysis.types import BoolArray, FloatArray, IntArray

WIDEST = math.log(1e3)  # largest change of a rate, either way, as a logarithm
MAX_JUMPS = 400  # kinds of jumps; with more, no rates are tested


@dataclass(frozen=True, slots=True)
class Rate:
    """Rates, or in discrete time probabilities, that are all wrong by one factor."""

    jumps: tuple[tuple[int, int], ...]  # (from, to) from 0
    origin: int | None  # the graph that is left, where it is all jumps from one; else None
    factor: float  # measured over nominal
    interval: tuple[float, float]  # 95 %, by the likelihood ratio
    log_p: float  # adjusted, see ``forward_selection``


def find_rates(counts: IntArray, chain: MarkovChain, dt: float, families: int, level: float) -> list[Rate]:
    """Find the rates that explain the counted transitions: score tests, then maximum likelihood of the factors.

    Parameters
    ----------
    counts
        (n, n) of transitions from step to step
    chain
        the nominal chain; with more than ``MAX_JUMPS`` kinds of jumps nothing is found
    dt
        length of a step [simulated time]
    families, level
        see ``selection.select``
    """
    n = chain.modes
    transition = chain.transition(dt)
    jumps = [(g, h) for g, h in np.argwhere(chain.matrix > 0.0).tolist() if g != h]
    if not jumps or len(jumps) > MAX_JUMPS:
        return []
    origin, target = np.array(jumps).T
    visits = counts.sum(axis=1)
    stay = np.diag(transition)
    # Log-likelihood of e^theta P_gh, with P_gg making up the difference: multinomial, row by row.
    odds = np.divide(transition[origin, target], stay[origin], out=np.zeros(len(jumps)), where=stay[origin] > 0.0)
    score = counts[origin, target] - counts[origin, origin] * odds
    expected = visits[origin] * transition[origin, target]
    information = np.diag(expected) + np.where(origin[:, None] == origin, expected[:, None] * odds, 0.0)
    identity = np.eye(len(jumps))
    classes = [
        [Candidate("jump", (g, h), identity[a]) for a, (g, h) in enumerate(jumps)],
        [Candidate("leaving", g, (origin == g) * 1.0) for g in range(n)],
        [Candidate("all", None, np.ones(len(jumps)))],
    ]
    selected, _ = select(score, information, classes, families, level)
    rates, matrix = [], chain.matrix
    for one in selected:
        chosen: BoolArray = np.zeros((n, n), np.bool_)
        if one.part == "jump":
            chosen[one.what] = True
        else:
            chosen[origin, target] = True if one.part == "all" else origin == one.what
        theta, interval = _likeliest(counts, MarkovChain(chain.time, matrix), dt, chosen)
        matrix = _scaled(matrix, chain, chosen, theta)
        where = tuple((g, h) for g, h in jumps if chosen[g, h])
        leaves = one.what if one.part == "leaving" else None
        rates.append(Rate(where, leaves, math.exp(theta), (math.exp(interval[0]), math.exp(interval[1])), one.log_p))
    return rates


def _likeliest(counts: IntArray, chain: MarkovChain, dt: float, chosen: BoolArray) -> tuple[float, tuple[float, float]]:
    """Logarithm of the factor of the chosen jumps, and the interval in which 2 log L falls by less than 3.84."""
    from scipy import optimize  # here, since few comparisons come this far

    highest = WIDEST
    if chain.time == "discrete":  # the diagonal must not become negative
        given = (chain.matrix * chosen).sum(axis=1)
        room = np.diag(chain.matrix) + given
        highest = min(highest, float(np.log(room[given > 0.0] / given[given > 0.0]).min()) - 1e-9)

    def less(theta: float) -> float:
        """Negative log-likelihood."""
        law = MarkovChain(chain.time, _scaled(chain.matrix, chain, chosen, theta)).transition(dt)
        with np.errstate(divide="ignore"):
            terms = np.where(counts > 0, counts * np.log(np.maximum(law, 1e-300)), 0.0)
        return -float(terms.sum())

    bounds = (-WIDEST, highest)
    theta = float(optimize.minimize_scalar(less, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)
    allowed = less(theta) + float(chi2_quantile(0.05, 1)) / 2.0
    ends = []
    for bound in bounds:
        inside = less(bound) <= allowed
        ends.append(
            bound
            if inside
            else float(optimize.brentq(lambda t: less(t) - allowed, min(theta, bound), max(theta, bound)))
        )
    return theta, (ends[0], ends[1])


def _scaled(matrix: FloatArray, chain: MarkovChain, chosen: BoolArray, theta: float) -> FloatArray:
    """Generator or transition matrix with the chosen jumps e^theta times as frequent."""
    scaled = np.where(chosen, matrix * math.exp(theta), matrix)
    np.fill_diagonal(scaled, 0.0)
    np.fill_diagonal(scaled, (1.0 if chain.time == "discrete" else 0.0) - scaled.sum(axis=1))
    return scaled
