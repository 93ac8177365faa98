"""The newest steps of a running network, and how late its agents are: against plain sorting and hand-made stamps."""

from __future__ import annotations

import numpy as np
import pytest

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.online_steps import WINDOW, Lateness, RecentSteps
from msg_analysis.model.phases import phases


def test_the_newest_steps_are_kept_in_order() -> None:
    """Whatever the pieces in which they come, and with what is missing between them."""
    generator = np.random.default_rng(4)
    steps = np.sort(generator.choice(2000, 900, replace=False))
    states = generator.normal(size=(900, 3, 2))
    kept, order = RecentSteps(), []
    for piece in np.array_split(np.arange(900), np.sort(generator.integers(0, 900, 40))):
        mixed = generator.permutation(piece)
        order += mixed.tolist()
        if len(mixed):
            kept.add(steps[mixed], steps[mixed] % 4, states[mixed])
    newest = kept.newest()
    assert newest is not None
    assert newest.steps.tolist() == steps[-WINDOW:].tolist()
    assert np.array_equal(newest.modes, newest.steps % 4)
    assert np.array_equal(newest.states, states[-WINDOW:, :, 0])


def test_nothing_is_kept_before_the_first_step() -> None:
    assert RecentSteps().newest() is None


def test_lateness_is_that_of_the_newest_steps_in_wall_time() -> None:
    """Agent i makes x(k) at (k - 1 + phi_i) dt of simulated time, of which there are four units in a second."""
    experiment = Experiment.parse(
        {
            "name": "late",
            "graphs": {"line": {"path": [1, 2, 3]}},
            "run": {"dt": 0.1, "duration": 100, "seed": 2, "pace": "realtime", "speed": 4},
        }
    )
    late, phi = Lateness(experiment), phases(experiment)
    assert late.medians() == [None, None, None]
    late.add(0, 0, 0)  # x(0) has no time
    assert late.medians()[0] is None
    for step in range(1, 1001):
        for agent, delay in ((0, 0.008), (1, 0.02 if step % 2 else 0.04), (2, 1.0 if step <= 1000 - WINDOW else 0.012)):
            late.add(agent, step, round(((step - 1 + phi[agent]) * 0.1 + delay) * 1e9))
    assert late.medians() == pytest.approx([0.002, 0.0075, 0.003], abs=1e-8)
