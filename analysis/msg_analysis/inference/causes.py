# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Diagnosis of a run that disagrees: single causes that explain it, with estimates, in words.

Causes are searched for in groups: frozen agents; gains, references and ignored messages (regression of the
innovations); noise variances; switching rates; losses; broadcast noise. Within a group they are selected forwards, each
given the others. Consequences across groups are removed: frozen agents are left out of the regression and of the noise,
and the part of the innovations that wrong gains explain is not counted as noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.text import HALF_WIDTH_95, percent
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.inference import candidates
from msg_analysis.inference.candidates import Cause, Selected, find_rates, numbers_text, select
from msg_analysis.inference.dependence import LongLags, StandingStill
from msg_analysis.inference.diagnostics import Finding, Place
from msg_analysis.inference.messages import LossTally, StaleValues
from msg_analysis.inference.noise_diagnostics import NoiseByGraph, NoiseOverTime
from msg_analysis.inference.residuals import BroadcastSums, InnovationSums, LargestInnovation
from msg_analysis.inference.statistics import binomial_interval, log_normal_tail
from msg_analysis.inference.switching import Sojourns, Transitions

ABOUT_THE_CHAIN = ("switching", "sojourns")


def frozen_cause(agent: int, still: int, steps: int, findings: Sequence[Finding]) -> Cause:
    """An agent, from 0, that did not move in so many of its steps; with the stretch if that is all of them."""
    share, interval = still / steps, binomial_interval(still, steps)
    when = "does not move in any of its steps" if still == steps else f"does not move in {percent(share)} of its steps"
    stretch = next((one.place for one in findings if one.test == StandingStill.test and one.agent == agent), None)
    where = None
    if stretch and still < steps and still == stretch.last - stretch.first + 1:
        when, where = f"stood still {_steps(stretch)}", (stretch.first, stretch.last)
    words = f"agent {agent + 1} {when}, although it has noise"
    return Cause("frozen", words, agent + 1, None, None, share, interval, 0.0, 0.0, where)


def departure_causes(
    findings: Sequence[Finding], names: Sequence[str], others: Sequence[Cause], families: int, level: float
) -> list[Cause]:
    """Causes that the ``others``, which concern the whole run, do not explain.

    Of departures of the innovations, the clearest one, if it is clearer than all other causes of the innovations: one
    fault departs in many ways. Sojourns, if the rates are right.
    """
    found = []
    chain = [one for one in findings if one.test == Sojourns.test]
    steps = [one for one in findings if one.test != Sojourns.test]
    for group, same in ((chain, True), (steps, False)):
        rivals = [cause.p or 0.0 for cause in others if (cause.kind in ABOUT_THE_CHAIN) == same]
        best = min(group, key=lambda one: one.log_p, default=None)
        if best is None:
            continue
        log_p = best.log_p + math.log(families)
        if log_p < math.log(level) and math.exp(log_p) < min(rivals, default=1.0):
            found.append(_cause(best, names, math.exp(log_p)))
    return found


def _cause(one: Finding, names: Sequence[str], p: float) -> Cause:
    agent = None if one.agent is None else one.agent + 1
    graph = None if one.graph is None else names[one.graph]
    where = (one.place.first, one.place.last) if one.place else None
    whose = "all agents" if agent is None else f"agent {agent}"
    value, expected = one.estimate or 0.0, one.expected
    half = HALF_WIDTH_95 * (one.standard_error or 0.0)
    interval = (value - half, value + half)
    said = numbers_text(value, interval)
    if one.test == Sojourns.test and one.span:
        first, last = one.span
        part = f"from step {first:,} of it on" if last is None else f"in steps {first:,} to {last:,} of it"
        part = f"in step {first:,} of it" if first == last else part
        words = (
            f"the probability of leaving graph {graph} depends on the length of the sojourn: it is {said} {part}, "
            f"not {expected:.3g}"
        )
        return Cause("sojourns", words, None, None, graph, value, interval, expected, p)
    if one.test == NoiseOverTime.test and one.span:
        words = (
            f"the size of the noise of {whose} has correlation {said} with its own {one.span[0]} steps before, not 0: "
            "its variance changes in time"
        )
        return Cause("noise", words, agent, None, None, value, interval, expected, p)
    if one.test in (NoiseByGraph.test, NoiseOverTime.test):
        when = f"in graph {graph}" if one.place is None else _steps(one.place)
        words = f"the noise variance of {whose} is {said} times what the file says {when}"
        return Cause("noise", words, agent, None, graph, value, interval, expected, p, where)
    if one.test == StandingStill.test and one.place:
        words = f"agent {agent} stood still {_steps(one.place)}, although it has noise"
        return Cause("frozen", words, agent, None, None, None, None, expected, p, where)
    if one.test == LargestInnovation.test and one.place:
        words = f"agent {agent}'s noise is {value:.3g} standard deviations {_steps(one.place)}"
        return Cause("outlier", words, agent, None, None, value, None, expected, p, where)
    if one.test == LongLags.test and one.span:
        words = f"the noise of {whose} has correlation {said} with its own {one.span[0]} steps before, not 0"
        return Cause("lag", words, agent, None, None, value, interval, expected, p)
    if one.test == StaleValues.test:
        link = None if one.sender is None or agent is None else (one.sender + 1, agent)
        which = f"the values of agent {link[0]} that agent {link[1]} uses" if link else "the values that agents use"
        share, around = percent(value), f"{100 * interval[0]:.3g} to {100 * interval[1]:.3g} %"
        words = f"{share} ({around}) of {which} are one step older than the log says"
        return Cause("stale", words, None, link, None, value, interval, expected, p)
    pair = [name for name in (graph, None if one.other is None else names[one.other]) if name]
    words = f"the log has the names of the graphs {' and '.join(pair)} swapped"
    return Cause("graph", f"{words} {_steps(one.place)}" if one.place else words, None, None, pair, p=p, steps=where)


def _steps(place: Place) -> str:
    of_run = f" of run {place.run}" if place.run > 1 else ""
    if place.first == place.last:
        return f"in step {place.first:,}{of_run}"
    return f"from step {place.first:,} to {place.last:,}{of_run}"


MAX_NOISE_PAIRS = 1225  # pairs of agents whose noise is tested for correlation, at most: 50 agents


@dataclass(frozen=True, slots=True, eq=False)
class Accused:
    """What is known of runs that disagree: the law, and sums over the runs."""

    names: Sequence[str]  # of the graphs
    chain: MarkovChain
    dt: float  # simulated time of a step
    reference: float
    innovations: InnovationSums
    transitions: Transitions
    loss: LossTally | None  # None without loss
    broadcast: BroadcastSums | None  # None without broadcast noise
    departures: Sequence[Finding] = ()  # of every kind that is tested


def find_causes(accused: Accused, level: float, rejected: Sequence[str]) -> list[Cause]:
    """Find what is wrong with runs that disagree: frozen agents first, then by p-value; never empty.

    ``level`` bounds the probability of finding a cause where nothing is wrong. Where nothing is found, one cause of
    kind "unknown" names the ``rejected`` tests.
    """
    sums, names = accused.innovations, accused.names
    still = candidates.frozen(sums)
    pardoned = [agent for agent, _, _ in still]
    gains = candidates.gains(sums, pardoned)
    losses = broadcast = None
    if accused.loss:
        losses = candidates.losses(accused.loss)
    if accused.broadcast:
        broadcast = candidates.variances(np.diag(accused.broadcast.scatter), accused.broadcast.samples)
    # All classes count before anything is selected: also the 3 of the rates and the 1 of the pairs.
    guess = candidates.noise(sums, pardoned, np.zeros(len(sums.terms)))
    groups = (gains, guess, losses, broadcast)
    families = sum(len(group.classes) for group in groups if group) + 4
    families += len(accused.departures)
    found = [frozen_cause(*entry, accused.departures) for entry in still]
    found += _switching(accused, families, level)
    change = np.zeros(len(sums.terms))
    if gains:
        selected, change = select(gains.score, gains.information, gains.classes, families, level)
        found += [_gain_words(one, accused) for one in selected]
    noise = candidates.noise(sums, pardoned, change)
    if noise:
        selected, _ = select(noise.score, noise.information, noise.classes, families, level)
        found += [_noise_words(one, names) for one in selected]
        if not change.any():  # wrong gains correlate the agents' innovations, too
            found += _correlations(sums, pardoned, families, level)
    if losses and accused.loss:
        selected, _ = select(losses.score, losses.information, losses.classes, families, level)
        found += [_loss_words(one, accused.loss) for one in selected]
    if broadcast:
        selected, _ = select(broadcast.score, broadcast.information, broadcast.classes, families, level)
        found += [_broadcast_words(one) for one in selected]
    found += departure_causes(accused.departures, names, found, families, level)
    if not found:
        return [_unknown(rejected)]
    return sorted(found, key=lambda cause: (cause.kind != "frozen", cause.p or 0.0))


def _gain_words(one: Selected, accused: Accused) -> Cause:
    part, what = one.part, one.what
    names, p = accused.names, math.exp(one.log_p)
    low, high = one.interval
    if part == "reference":
        at = accused.reference
        numbers = numbers_text(at + one.estimate, (at + low, at + high))
        words = f"the leaders are pulled to {numbers}, not to the reference {at:g}"
        return Cause("reference", words, None, None, None, at + one.estimate, (at + low, at + high), at, p)
    if part == "offset":
        value, interval = one.estimate / accused.dt, (low / accused.dt, high / accused.dt)
        words = f"agent {what + 1} has an additional drift of {numbers_text(value, interval)} per unit of time"
        return Cause("offset", words, what + 1, None, None, value, interval, 0.0, p)
    factor, interval = 1.0 + one.estimate, (1.0 + low, 1.0 + high)
    if part in ("all", "sender") and -1.2 < one.estimate < 0.0:
        share, around = -one.estimate, (max(-high, 0.0), -low)
        whose = "all messages" if part == "all" else f"the messages of agent {what + 1}"
        shown = f"{percent(share)} ({100 * around[0]:.3g} to {100 * around[1]:.3g} %)"
        words = f"{shown} of {whose} have no effect: they are ignored, or all gains on them are too small by this share"
        return Cause("ignored", words, None if part == "all" else what + 1, None, None, share, around, 0.0, p)
    whose, agent, link, graph = _whose_gain(part, what)
    name = None if graph is None else names[graph]
    where = "" if name is None else f" in graph {name}"
    words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
    return Cause("gain", words, agent, link, name, factor, interval, 1.0, p)


def _whose_gain(part: str, what: Any) -> tuple[str, int | None, tuple[int, int] | None, int | None]:
    """In words; agent and link from 1, graph from 0."""
    if part == "link":
        sender, receiver, graph = what
        return f"the gain of agent {receiver + 1} on agent {sender + 1}", None, (sender + 1, receiver + 1), graph
    if part == "edge":
        pair, graph = what
        first, second = sorted(pair)
        return f"the gain of edge {first + 1}-{second + 1} in both directions", None, (first + 1, second + 1), graph
    if part == "receiver in graph":
        return f"agent {what[0] + 1}'s gain on all that it hears", what[0] + 1, None, what[1]
    if part == "receiver":
        return f"agent {what + 1}'s gain on all that it hears", what + 1, None, None
    if part == "leader":
        return f"agent {what + 1}'s gain as a leader", what + 1, None, None
    if part == "sender":
        return f"the gain of all others on agent {what + 1}", what + 1, None, None
    if part == "graph":
        return "every gain", None, None, what
    return ("the gain of the leaders" if part == "leaders" else "every gain"), None, None, None


def _noise_words(one: Selected, names: Sequence[str]) -> Cause:
    part, what = one.part, one.what
    agent = {"agent": what, "agent in graph": what[0] if part == "agent in graph" else None}.get(part)
    graph = {"graph": what, "agent in graph": what[1] if part == "agent in graph" else None}.get(part)
    name = None if graph is None else names[graph]
    whose = "the noise variance of all agents" if agent is None else f"agent {agent + 1}'s noise variance"
    where = "" if name is None else f" in graph {name}"
    factor, interval = math.exp(one.estimate), (math.exp(one.interval[0]), math.exp(one.interval[1]))
    words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
    number = None if agent is None else agent + 1
    return Cause("noise", words, number, None, name, factor, interval, 1.0, math.exp(one.log_p))


def _correlations(sums: InnovationSums, pardoned: Sequence[int], families: int, level: float) -> list[Cause]:
    """Pairs of agents whose noise correlation differs from the expected one, by Fisher's z."""
    m = sums.still.shape[1]
    agents = [i for i in range(m) if i not in pardoned]
    pairs = [(i, j) for place, i in enumerate(agents) for j in agents[:place]]
    if not 0 < len(pairs) <= MAX_NOISE_PAIRS:
        return []
    samples = int(sums.samples.sum())
    should = np.tensordot(sums.samples, sums.noises, axes=1)
    scatter = sums.scatter.sum(axis=0)
    found = []
    for j, i in sorted((j, i) for i, j in pairs):
        size, expected_size = scatter[i, i] * scatter[j, j], should[i, i] * should[j, j]
        if size <= 0.0 or expected_size <= 0.0 or samples < candidates.MIN_SAMPLES:
            continue
        seen, expected = scatter[i, j] / math.sqrt(size), should[i, j] / math.sqrt(expected_size)
        if 1.0 - expected**2 < 1e-6 or 1.0 - seen**2 < 1e-12:
            continue
        z = (math.atanh(seen) - math.atanh(expected)) * math.sqrt(samples - 3)
        log_p = math.log(2.0 * len(pairs) * families) + float(log_normal_tail(abs(z)))
        if log_p < math.log(level):
            half = HALF_WIDTH_95 / math.sqrt(samples - 3)
            interval = math.tanh(math.atanh(seen) - half), math.tanh(math.atanh(seen) + half)
            words = (
                f"the noise of agents {j + 1} and {i + 1} has correlation {numbers_text(seen, interval)}, "
                f"not {expected:.3g}"
            )
            link = (j + 1, i + 1)
            found.append(Cause("correlation", words, None, link, None, seen, interval, expected, math.exp(log_p)))
    return found


def _switching(accused: Accused, families: int, level: float) -> list[Cause]:
    """Switching rates, or in discrete time probabilities, that are wrong."""
    names, counts = accused.names, accused.transitions.counts
    transition = accused.chain.transition(accused.dt)
    found = []
    for g, h in np.argwhere((counts > 0) & (transition == 0.0)).tolist():
        words = f"the graph jumped {counts[g, h]} times from {names[g]} to {names[h]}, which the law excludes"
        found.append(Cause("switching", words, None, None, [names[g], names[h]], float(counts[g, h]), None, 0.0, 0.0))
    if found:
        return found
    what = "rate" if accused.chain.time == "continuous" else "probability"
    for rate in find_rates(counts, accused.chain, accused.dt, families, level):
        low, high = rate.interval
        if len(rate.jumps) == 1:
            g, h = rate.jumps[0]
            expected = float(accused.chain.matrix[g, h])
            estimate, interval = rate.factor * expected, (low * expected, high * expected)
            words = (
                f"the {what} of switching from {names[g]} to {names[h]} is {numbers_text(estimate, interval)}, "
                f"not {expected:.3g}"
            )
            where: list[str] | None = [names[g], names[h]]
        else:
            expected, estimate, interval = 1.0, rate.factor, (low, high)
            where = None if rate.origin is None else [names[rate.origin]]
            whose = f"all {what}s" if where is None else f"the {what}s of switching away from {where[0]}"
            whose = f"{whose} of switching" if where is None else whose
            whose = whose.replace("probabilitys", "probabilities")
            words = f"{whose} are {numbers_text(estimate, interval)} times what the file says"
        found.append(Cause("switching", words, None, None, where, estimate, interval, expected, math.exp(rate.log_p)))
    return found


def _loss_words(one: Selected, tally: LossTally) -> Cause:
    part, what = one.part, one.what
    receiver, sender = tally.pairs.T
    chosen = np.ones(len(receiver), dtype=np.bool_)
    agent, link, whose = None, None, "all messages"
    if part == "link":
        chosen = (sender == what[0]) & (receiver == what[1])
        link, whose = (what[0] + 1, what[1] + 1), f"the messages from agent {what[0] + 1} to agent {what[1] + 1}"
    elif part in ("receiver", "sender"):
        chosen = (receiver if part == "receiver" else sender) == what
        agent, whose = what + 1, f"the messages {'to' if part == 'receiver' else 'of'} agent {what + 1}"
    lost, messages = int(tally.lost[chosen].sum()), int(tally.messages[chosen].sum())
    weights = tally.messages[chosen] / messages
    expected = float(weights @ tally.probability[chosen])
    # In bursts, so many messages say as much as fewer independent ones.
    alike = float(weights @ tally.inflation[chosen])
    share, interval = lost / messages, binomial_interval(round(lost / alike), round(messages / alike))
    words = (
        f"{percent(share)} ({100 * interval[0]:.3g} to {100 * interval[1]:.3g} %) of {whose} are lost, "
        f"not {percent(expected)}"
    )
    again = tally.after_losses(chosen)
    if again:
        words += f"; after a lost one, {percent(again[0])} are, not {percent(again[1])}"
    return Cause("loss", words, agent, link, None, share, interval, expected, math.exp(one.log_p))


def _broadcast_words(one: Selected) -> Cause:
    part, what = one.part, one.what
    factor, interval = math.exp(one.estimate), (math.exp(one.interval[0]), math.exp(one.interval[1]))
    agent = what + 1 if part == "agent" else None
    whose = "all agents publish" if agent is None else f"agent {agent} publishes"
    words = f"the variance of the noise in what {whose} is {numbers_text(factor, interval)} times what the file says"
    return Cause("broadcast", words, agent, None, None, factor, interval, 1.0, math.exp(one.log_p))


def _unknown(rejected: Sequence[str]) -> Cause:
    names = ", ".join(rejected)
    if list(rejected) == ["innovations: whiteness"]:
        words = "the noise of successive steps or of replicas is correlated: random numbers are used twice"
    elif set(rejected) <= {"system error", "covariance"} or all(name.startswith("error of") for name in rejected):
        words = f"the steps follow the law, but the errors differ: chance, or another start than in the file ({names})"
    else:
        words = f"no single cause that is searched for explains the rejected tests ({names})"
    return Cause("unknown", words)
