"""Running estimates against the comparison of the whole run, and against plain sums."""

import math
import random
from typing import Any

import numpy as np
import pytest

from experiments import Experiment, Run, line_ring, observed, predict, simulate
from msg_analysis.arithmetic.update_law import to_payload
from msg_analysis.inference.estimates import Estimate, estimates
from msg_analysis.inference.online_errors import LiveEstimate, LiveReport, RunningErrors
from msg_analysis.inference.online_steps import WINDOW, Lateness, RecentSteps, StepCollector
from msg_analysis.inference.time_means import time_means
from msg_analysis.model.step_model import phases
from msg_analysis.theory.sampling import sampled_prediction


def four(agents: int = 4, **changes: Any) -> Run:
    """A run of 300 steps."""
    chain = {"generator": [[-1.0, 1.0], [0.5, -0.5]]}
    run = {"dt": 0.1, "duration": 30, "seed": 5} | changes.pop("run", {})
    return simulate(line_ring(agents, **{"switching": chain} | changes, run=run))


def messages(trajectory: Run) -> list[tuple[int, int, int, bytes]]:
    """(agent, step, mode from 1, payload) of every state, in the order of steps."""
    modes = [0, *(trajectory.modes + 1).tolist()]
    return [(i, k, modes[k], to_payload(x)) for k, states in enumerate(trajectory.states) for i, x in enumerate(states)]


def report_of(trajectory: Run, **options: bool) -> LiveReport:
    """What a watcher says that has heard everything."""
    live = LiveEstimate(trajectory.record, **options)
    for message in messages(trajectory):
        live.add(*message)
    return live.report()


def errors_from_zero(experiment: Experiment, steps: int) -> list[float]:
    """Expected system error of every step, by the recursion of the second moments of the states themselves."""
    step = predict(experiment).step
    centre = np.eye(step.agents) - 1.0 / step.agents
    moments, found = np.zeros((step.modes, step.agents, step.agents)), []
    for _ in range(steps):
        found.append(float(np.trace(centre @ moments.sum(axis=0) @ centre)))
        made = step.weights @ moments @ step.weights.transpose(0, 2, 1)
        moments = np.einsum("ji,jab->iab", step.transition, made + step.stationary[:, None, None] * step.noise)
    return found


def numbers(*found: Estimate) -> np.ndarray:
    rows = [[e.measured, e.predicted, e.standard_error, e.z, e.p, e.p_adjusted] for e in found]
    return np.array(rows, dtype=float)


SLOW = {"generator": [[-0.2, 0.2], [0.2, -0.2]], "initial": "ring"}
CASES = {
    "stationary": {},
    "from zero": {"run": {"start": "zero"}},
    "from known values, first graph given": {
        "run": {"start": [3.0, -1.0, 0.0, 2.0]},
        "switching": SLOW,
    },
    "first graph given": {"switching": SLOW},
    "tracking": {"problem": "tracking", "leaders": {"agents": [2], "gain": 1.0, "reference": 3.0}},
    "grounded": {"problem": "tracking", "leaders": {"agents": [2], "gain": "inf", "reference": 3.0}},
    "loss and noise on the air": {"noise": {"loss": 0.1, "broadcast": 0.2, "link": 0.1}},
    "loss, from zero": {"noise": {"loss": 0.1}, "run": {"start": "zero"}},
    "discrete": {
        "time": "discrete",
        "switching": {"transition": [[0.9, 0.1], [0.2, 0.8]]},
        "run": {"dt": 1.0, "duration": 300},
    },
}


@pytest.mark.parametrize("case", CASES)
def test_the_same_numbers_as_a_comparison(case: str) -> None:
    """Also if it is asked often, and the states of neighbouring steps come in disorder."""
    trajectory = four(**CASES[case])
    observation = observed(trajectory)
    system, nodes = estimates(time_means(observation), observation.prediction.system)
    live, rng = LiveEstimate(trajectory.record, evidence=False), random.Random(1)
    order = sorted(messages(trajectory), key=lambda message: message[1] + 20 * rng.random())
    for number, message in enumerate(order):
        live.add(*message)
        if number % 100 == 50:
            live.report()
    report = live.report()
    assert (report.first, report.last, report.steps, report.missing) == (0, 299, 300, 0)
    assert (report.refused, report.note) == ({}, None)
    np.testing.assert_allclose(numbers(report.system, *report.nodes), numbers(system, *nodes), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("more", [{}, {"noise": {"delay": 2, "link": 0.3}}], ids=["plain", "late"])
def test_of_a_schedule_the_expectation_so_far(more: dict[str, Any]) -> None:
    schedule = {"schedule": [[0, "line"], [1.5, "ring"], [9, "line"]], "end": 20, "repeat": True}
    trajectory = four(switching=schedule, **more)
    whole = observed(trajectory)
    report = report_of(trajectory, evidence=False)
    system, nodes = estimates(time_means(whole), whole.prediction.system)
    found = np.array([(e.measured, e.predicted) for e in (report.system, *report.nodes)], dtype=float)
    wanted = np.array([(e.measured, e.predicted) for e in (system, *nodes)], dtype=float)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert report.system.standard_error is None


@pytest.mark.parametrize("start", ["stationary", "zero"])
def test_who_comes_late_expects_what_is_left(start: str) -> None:
    """Nothing before step 20, and nothing of some steps: measured and expected are means over the same steps."""
    trajectory = four(run={"start": start})
    live = LiveEstimate(trajectory.record)
    for message in messages(trajectory):
        if message[1] >= 20 and not (message[0] == 2 and message[1] in (77, 78, 90)):
            live.add(*message)
    report = live.report()
    steps = [k for k in range(20, 300) if k not in (76, 77, 78, 89, 90)]  # those with the next one there too
    assert (report.first, report.last, report.steps, report.missing) == (20, 299, len(steps), 5)
    deviations = trajectory.states - trajectory.states.mean(axis=1, keepdims=True)
    squares = (deviations**2).mean(axis=2)[steps].mean(axis=0)
    np.testing.assert_allclose([node.measured for node in report.nodes], squares)
    if start == "stationary":
        wanted = predict(trajectory.record.experiment).emulated.system_error
    else:
        all_errors = errors_from_zero(trajectory.record.experiment, 300)
        wanted = np.mean([all_errors[k] for k in steps])
    assert report.system.predicted == pytest.approx(wanted, rel=1e-9)


def test_a_sampled_error_is_shown_with_its_interval() -> None:
    """With bursts on ten links: that of every agent, too, and why there is no test."""
    report = report_of(simulate(line_ring(5, noise={"loss": 0.2, "burst": 5}, run={"dt": 0.1, "duration": 30})))
    sampled = sampled_prediction(line_ring(5, noise={"loss": 0.2, "burst": 5}, run={"dt": 0.1}), precision=0.02)
    low, high = sampled.interval
    assert report.system.predicted == sampled.system_error
    assert [node.predicted for node in report.nodes] == sampled.node_errors.tolist()
    assert (report.system.standard_error, report.system.z) == (None, None)
    wanted = f"predicted: of the steady state, sampled, {low:.6g} to {high:.6g} (95 %), without a test: noise.burst: 5"
    assert report.note is not None
    assert report.note.startswith(wanted)


@pytest.mark.parametrize("steps", [slice(100, 101), slice(100, None)], ids=["one step", "from a step on"])
def test_numbers_too_large_to_compute_with(steps: slice) -> None:
    """The square of 1e200 is no number: what is shown is huge, and still a number, the standard errors too."""
    trajectory = four()
    trajectory.states[steps, 1] = 1e200
    with np.errstate(all="raise"):
        report = report_of(trajectory)
    assert np.isfinite(numbers(report.system)[:, :5]).all()
    assert np.isfinite(numbers(*report.nodes)).all()
    assert min(estimate.measured or 0.0 for estimate in (report.system, *report.nodes)) > 1e100


def test_many_agents() -> None:
    """Looked at in one step of two: standard errors of the nodes a little off, all else to the last digits."""
    trajectory = four(25, run={"replicas": 1})
    observation = observed(trajectory)
    system, nodes = estimates(time_means(observation), observation.prediction.system)
    errors = RunningErrors(trajectory.record, observation.prediction)
    errors.add(np.arange(300), trajectory.modes, trajectory.states[:-1], trajectory.states[1:])
    ours, our_nodes = errors.estimates()
    np.testing.assert_allclose(numbers(ours), numbers(system), rtol=1e-9)
    np.testing.assert_allclose(numbers(*our_nodes)[:, :2], numbers(*nodes)[:, :2], rtol=1e-9)
    np.testing.assert_allclose(numbers(*our_nodes)[:, 2], numbers(*nodes)[:, 2], rtol=0.01)


def test_too_many_agents_for_standard_errors_of_each() -> None:
    trajectory = four()
    assert not RunningErrors(trajectory.record, predict(trajectory.record.experiment), most_bytes=100).nodes_tested
    report = report_of(trajectory, nodes=False)
    assert report.note == "too many agents for intervals of the agent errors"
    assert report.system.z is not None
    assert [node.standard_error for node in report.nodes] == [None] * 4
    assert sum(node.measured or 0.0 for node in report.nodes) == pytest.approx(report.system.measured)


def test_gaps_leave_the_standard_error_on_the_safe_side() -> None:
    """Half of the steps at random: the standard deviation of z is 0.7, here with an error of 0.06."""
    z, prediction = [], None
    for seed in range(60):
        trajectory = four(run={"seed": seed, "duration": 20, "replicas": 1})
        prediction = prediction or predict(trajectory.record.experiment)
        errors = RunningErrors(trajectory.record, prediction)
        steps = np.flatnonzero(np.random.default_rng(seed).random(200) < 0.5)
        errors.add(steps, trajectory.modes[steps], trajectory.states[steps], trajectory.states[steps + 1])
        z.append(errors.estimates()[0].z)
    assert 0.35 < np.std(np.array(z, dtype=float)) < 1.0


def test_in_real_time_nothing_is_claimed() -> None:
    trajectory = four(run={"pace": "realtime"})
    report = report_of(trajectory, evidence=False)
    assert (report.first, report.last, report.steps) == (0, 300, 301)
    assert report.system.standard_error is report.system.z is None
    assert "real time" in str(report.note)
    deviations = trajectory.states - trajectory.states.mean(axis=1, keepdims=True)
    assert report.system.measured == pytest.approx((deviations**2).mean(axis=2).sum(axis=1).mean())
    assert report.system.predicted == pytest.approx(predict(trajectory.record.experiment).emulated.system_error)


def collect(*states: tuple[int, int, int, float]) -> tuple[StepCollector, list[int]]:
    """Two agents, two graphs, 1000 steps; the steps that are ready."""
    collector = StepCollector(2, 2, 1000, lockstep=True)
    for agent, step, mode, value in states:
        collector.add(agent, step, mode, np.array([value]).tobytes())
    steps, modes, here, after = collector.take()
    assert here.shape == after.shape == (len(steps), 2, 1 if len(steps) else 0)
    assert len(modes) == len(steps)
    return collector, steps.tolist()


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ((0, 1, 2, 9.0), "contradicts an earlier copy"),
        ((0, 1, 1, 3.0), "contradicts an earlier copy"),
        ((0, 1, 2, math.nan), "not finite"),
        ((0, 1, 1, 3.0), "agents used different graphs"),
    ],
)
def test_what_cannot_be_trusted_does_not_count(wrong: tuple[int, int, int, float], reason: str) -> None:
    good = [(i, k, min(k, 1) * 2, 3.0) for k in range(5) for i in (0, 1)]
    if reason == "contradicts an earlier copy":
        states = [*good[:3], wrong, *good[3:]]  # right behind the true one
    else:
        states = [wrong if entry[:2] == wrong[:2] else entry for entry in good]
    collector, steps = collect(*states)
    assert steps == [2, 3]
    assert collector.refused[reason] >= 1


def test_repetitions_and_who_comes_in_the_middle() -> None:
    """A step is ready with the next one."""
    good = [(i, k, min(k, 1), 3.0) for k in range(3) for i in (0, 1)]
    collector, steps = collect(*good, good[-1], (0, 1001, 1, 0.0), good[0])
    assert steps == [0, 1]
    assert collector.refused == {"received again": 1, "too late": 1, "step out of range": 1, "not finite": 0}
    collector = StepCollector(2, 2, 10**12, lockstep=True)
    for step in range(10**11, 10**11 + 3):
        for agent in (0, 1):
            collector.add(agent, step, 1, bytes(8))
    assert collector.take()[0].tolist() == [10**11, 10**11 + 1]
    assert RecentSteps().newest() is None


def test_waiting_is_bounded() -> None:
    """One agent is never heard: what waits for it is forgotten after a while."""
    collector = StepCollector(2, 2, 10**6, lockstep=True)
    for step in range(20_000):
        collector.add(0, step, 1, bytes(8))
    assert len(collector._rows) < 5500
    assert collector.newest == 19_999
    for step in range(19_990, 19_995):
        collector.add(1, step, 1, bytes(8))
    assert collector.take()[0].tolist() == [19_990, 19_991, 19_992, 19_993]
    collector.add(1, 10, 1, bytes(8))
    assert collector.refused["too late"] == 1


def test_what_was_lost_and_sent_again_counts() -> None:
    """The middleware repairs what was lost on the way, and meanwhile hands on what others send."""
    collector = StepCollector(2, 2, 10**6, lockstep=True)
    for agent, step in np.ndindex(2, 5000):
        collector.add(agent, step, 1, bytes(8))
    assert (collector.take()[0].tolist(), collector.refused["too late"]) == (list(range(4999)), 0)


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
    assert newest.steps.tolist() == steps[-WINDOW:].tolist()
    assert np.array_equal(newest.modes, newest.steps % 4)
    assert np.array_equal(newest.states, states[-WINDOW:, :, 0])


def test_lateness_is_that_of_the_newest_steps_in_wall_time() -> None:
    """Agent i makes x(k) at (k - 1 + phi_i) dt of simulated time, of which there are four units in a second."""
    experiment = line_ring(run={"dt": 0.1, "duration": 100, "pace": "realtime", "speed": 4})
    late, phi = Lateness(experiment), phases(experiment)
    late.add(0, 0, 0)  # x(0) has no time
    assert late.medians() == [None] * 3
    for step in range(1, 1001):
        for agent, delay in ((0, 0.008), (1, 0.02 if step % 2 else 0.04), (2, 1.0 if step <= 1000 - WINDOW else 0.012)):
            late.add(agent, step, round(((step - 1 + phi[agent]) * 0.1 + delay) * 1e9))
    assert late.medians() == pytest.approx([0.002, 0.0075, 0.003], abs=1e-8)
