"""Decay rates: against closed forms where the eigenvalues of the whole matrix are wrong; where nothing is certain."""

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest

from experiments import Experiment, line_ring, predict
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.settling import Rates, asymptotic_rates
from msg_analysis.theory.transient import MAX_UNKNOWNS, unknowns


def network(arcs: list[list[float]], problem: str, time: str = "continuous", **changes: Any) -> Experiment:
    """Two graphs with the same arcs."""
    changes |= {"problem": problem, "time": time, "graphs": {"a": {"arcs": arcs}, "b": {"arcs": arcs}}}
    changes |= {"switching": {"transition": [[0.5, 0.5], [0.5, 0.5]]}} if time == "discrete" else {}
    return line_ring(**changes | ({"leaders": {"agents": [1], "gain": 1}} if problem == "tracking" else {}))


def chain(agents: int) -> list[list[float]]:
    """Agent i + 1 hears agent i."""
    return [[i, i + 1] for i in range(1, agents)]


def of_run(experiment: Experiment) -> Rates:
    return asymptotic_rates(predict(experiment).system)


@pytest.mark.parametrize("agents", [5, 10, 24, 30])
@pytest.mark.parametrize("problem", ["consensus", "tracking"])
def test_chains(problem: str, agents: int) -> None:
    """Every agent forgets at rate 1, in a step of 0.05 by the factor 0.95, in discrete time by exp(-1)."""
    experiment = network(chain(agents), problem)
    rates = asymptotic_rates(systems.continuous(experiment))
    assert (rates.mean, rates.second_moment, rates.graph) == pytest.approx((1.0, 2.0, 2.0), rel=1e-12)
    rates = of_run(experiment)
    assert (rates.mean, rates.second_moment) == pytest.approx((-np.log(0.95), -2 * np.log(0.95)), rel=1e-12)
    rates = of_run(network(chain(agents), problem, "discrete"))
    assert (rates.mean, rates.second_moment) == pytest.approx((1.0, 2.0), rel=1e-12)


@pytest.mark.parametrize("problem", ["consensus", "tracking"])
@pytest.mark.parametrize("delay", [1, 3])
def test_chains_with_delay(problem: str, delay: int) -> None:
    """Nobody hears itself late, so nothing changes."""
    rates = of_run(network(chain(5), problem, "discrete", noise={"process": 1, "delay": delay}))
    assert (rates.mean, rates.second_moment) == pytest.approx((1.0, 2.0), rel=1e-12)


@pytest.mark.parametrize("loss", [0.1, 0.6])
def test_chains_with_loss(loss: float) -> None:
    """An agent keeps 0.95 of its error if it hears the other, all of it if not; its leader loses nothing."""
    rates = of_run(network(chain(12), "consensus", noise={"process": 1, "loss": loss}))
    heard = 1 - loss
    expected = (-np.log(loss + heard * 0.95), -np.log(loss + heard * 0.95**2))
    assert (rates.mean, rates.second_moment) == pytest.approx(expected, rel=1e-12)


def test_a_ring_that_is_followed() -> None:
    """Three agents in a directed ring, and a chain of ten behind it: the ring's eigenvalues, or those of the chain."""
    for weight, expected in ((0.4, 0.6), (5.0, 1.0)):  # the ring of weight w decays at 3 w / 2
        arcs = [[1, 2, weight], [2, 3, weight], [3, 1, weight], *([i, i + 1] for i in range(3, 13))]
        rates = asymptotic_rates(systems.continuous(network(arcs, "consensus")))
        assert (rates.mean, rates.second_moment) == pytest.approx((expected, 2 * expected), rel=1e-9)


def bisected(function: Callable[[mpmath.mpf], mpmath.mpf]) -> mpmath.mpf:
    """Zero of a function that is < 0 at 0 and > 0 at 1, up to 2^-200."""
    low, high = mpmath.mpf(0), mpmath.mpf(1)
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) < 0 else (low, middle)
    return low


@pytest.mark.parametrize("agents", [5, 10, 20])
@pytest.mark.parametrize("heard", [1e-3, 1e-9, 1e-13])
def test_right_or_not_given(agents: int, heard: float) -> None:
    """A chain whose last agent is heard by the first, hardly; of 20, the second moments are iterated."""
    # With x = 1 - rate, the determinant is x^agents + heard (x^(agents - 1) - 1). The slowest rate belongs to the
    # largest eigenvalue x, which is real and positive (Perron), and there is only one of these (Descartes): in 60
    # digits.
    arcs = [*chain(agents), [agents, 1, heard]]
    rates = asymptotic_rates(systems.continuous(network(arcs, "tracking")))
    with mpmath.workdps(60):
        loose = mpmath.mpf(heard)
        expected = float(1 - bisected(lambda x: x**agents + loose * (x ** (agents - 1) - 1)))
    assert rates.mean in (None, pytest.approx(expected, rel=1e-6))
    assert rates.second_moment in (None, pytest.approx(2 * expected, rel=1e-6))
    assert heard != 1e-3 or None not in (rates.mean, rates.second_moment)


def test_consensus_that_nobody_can_know_is_not_given() -> None:
    """Of 18 agents: so many that the second moments are iterated."""
    arcs = [*chain(18), [18, 1, 1e-13]]
    system = systems.continuous(network(arcs, "consensus"))
    assert unknowns(system) > MAX_UNKNOWNS
    rates = asymptotic_rates(system)
    assert (rates.mean, rates.second_moment, rates.graph) == (None, None, pytest.approx(2.0))
