"""Evidence of a watcher, from what the messages log: that of the comparison of the whole run, for every law."""

from pathlib import Path
from typing import Any

import late_timers
import numpy as np
import pytest
from late_timers import busy
from mcap.reader import make_reader
from tests.support.watched_run import messages_of, watch, watched, whole_sums

from experiments import Experiment, five, predict, simulate, write_trajectory
from msg_analysis.inference.online_errors import LiveEstimate
from msg_analysis.inference.online_evidence import NetworkPath

LAWS: dict[str, dict[str, Any]] = {
    "plain": {},
    "link": {"noise": {"link": 0.3}},
    "broadcast": {"noise": {"broadcast": 0.3}},
    "loss": {"noise": {"loss": 0.3}},
    "loss of one link": {"noise": {"loss": {"arcs": [[1, 2, 0.5]]}}},
    "everything": {"noise": {"loss": 0.3, "link": 0.2, "broadcast": 0.1, "delay": 1}},
    "hold": {"noise": {"loss": 0.3, "on_loss": "hold"}},
    "hold, link": {"noise": {"loss": 0.3, "on_loss": "hold", "link": 0.2, "broadcast": 0.2}},
    "burst": {"noise": {"loss": {"arcs": [[1, 2, 0.2], [2, 1, 0.2]]}, "burst": 4}},
    "burst, hold": {"noise": {"loss": {"arcs": [[1, 2, 0.2]]}, "burst": 4, "on_loss": "hold"}},
    "delay": {"noise": {"delay": 3}},
    "delay, link": {"noise": {"delay": 12, "link": 1.0, "loss": 0.1}},
    "delay, hold": {"noise": {"delay": 2, "loss": 0.2, "on_loss": "hold"}},
    "correlated": {"noise": {"process": [[1.0, 0.5, 0, 0, 0], *np.eye(5).tolist()[1:]], "loss": 0.3}},
    "leaders": {
        "problem": "tracking",
        "leaders": {"agents": [2], "gain": 1.5, "reference": 3.0},
        "noise": {"loss": 0.2},
    },
    "states far from zero": {"run": {"start": [1e15] * 5}},
    "real time": {"run": {"pace": "realtime"}},
    "real time, states far from zero": {"run": {"pace": "realtime", "start": [1e15] * 5}},
    "real time, on the air": {"noise": {"loss": 0.3, "broadcast": 0.2}, "run": {"pace": "realtime"}},
    "real time, hold": {"noise": {"loss": 0.3, "on_loss": "hold"}, "run": {"pace": "realtime"}},
    "real time, link": {"noise": {"link": 0.3}, "run": {"pace": "realtime"}},
    "real time, delay": {"noise": {"delay": 2}, "run": {"pace": "realtime"}},
}


def law(duration: float = 40.0, seed: int = 1, **changes: Any) -> Experiment:
    return five(seed, duration, **{**changes, "run": {"replicas": 2} | changes.get("run", {})})


@pytest.mark.parametrize("name", ["everything", "real time"])
def test_messages_are_those_of_the_bag(name: str, tmp_path: Path) -> None:
    """Read by the library of MCAP: all but the record of the run, in the order of time."""
    run = simulate(law(duration=20.0, **LAWS[name]))
    write_trajectory(run, tmp_path / "bag")
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        # Ordered here: by the library, it takes three times as long.
        records = list(make_reader(stream).iter_messages(log_time_order=False))
    records.sort(key=lambda record: record[2].log_time)
    assert [(channel.topic, message.data) for _, channel, message in records[1:]] == messages_of(run)
    assert records[0][1].topic == "/experiment"


@pytest.mark.parametrize("name", LAWS)
def test_is_the_evidence_of_the_comparison(name: str) -> None:
    """Whatever the order of the states is, and however often one looks."""
    run = simulate(law(duration=20.0, **LAWS[name]))
    # Where the states alone count, so does the next graph, which comes with the next step.
    disorder = 0.0 if name in ("plain", "states far from zero") else 30.0
    live, wanted = watched(run, disorder=disorder), whole_sums(run, predict(run.record.experiment))
    found, families = live.report(), live.evidence.sums.families()
    assert (found.refused, live.evidence.count) == ({}, 400)
    for kind, logarithms in wanted.families().items():
        assert families[kind] == pytest.approx(logarithms, rel=1e-8, abs=1e-8), kind
    assert found.any_time.log_evidence == pytest.approx(wanted.evidence(), abs=1e-8)


def test_late_agents() -> None:
    """Agents of a run in real time are far apart: values are used that are older, or newer, than the step."""
    run = late_timers.run(law(**LAWS["real time"]), late=busy(0.4, 2.5), slow=busy(0.2, 3.0))
    assert (run.used > np.arange(800)[:, None, None]).any()
    live, wanted = watched(run), whole_sums(run, predict(run.record.experiment))
    assert live.report().any_time.log_evidence == pytest.approx(wanted.evidence(), abs=1e-8)


@pytest.mark.parametrize("name", ["everything", "hold", "real time"])
def test_steps_that_were_not_seen(name: str) -> None:
    """They are left out, and so are agents that used a value of theirs; the rest is exact."""
    run = simulate(law(duration=200.0, **LAWS[name]).with_run(replicas=4))
    hidden = {*range(500, 700), *np.flatnonzero(np.random.default_rng(3).random(4000) < 0.05).tolist()}

    class WithGaps(LiveEstimate):
        def add(self, agent: int, step: int, *message: Any, **options: Any) -> None:
            if step not in hidden:
                super().add(agent, step, *message, **options)

    live = WithGaps(run.record)
    watch(live, messages_of(run))
    sums = live.evidence.sums
    both = [k for k in range(4000) if k not in hidden and k + 1 not in hidden]
    assert 0.95 * len(both) < live.evidence.count <= len(both)  # the last ones may wait for values
    assert 0.85 * len(both) * 4 < sums.total.samples.min()
    assert name == "real time" or sums.total.samples.max() < live.evidence.count * 4
    # What is there follows the law: chi-square, within five standard deviations of each agent.
    assert (np.abs(sums.total.squares - sums.total.samples) < 5 * np.sqrt(2.0 * sums.total.samples)).all()
    assert live.report().any_time.log_evidence < np.log(100.0)


def test_values_older_than_what_is_kept() -> None:
    """Which agents are left out depends on losses only, so that the evidence stays fair, and losses all count."""
    run = simulate(law(duration=60.0, noise={"loss": 0.7, "on_loss": "hold"}))
    live, wanted = LiveEstimate(run.record, kept=8), whole_sums(run, predict(run.record.experiment))
    watch(live, messages_of(run))
    sums = live.evidence.sums
    assert (sums.total.samples < wanted.total.samples).all()
    assert (sums.total.samples > 0.5 * wanted.total.samples).all()
    assert sums.total.lost.tolist() == wanted.total.lost.tolist()
    assert sums.total.messages.tolist() == wanted.total.messages.tolist()
    assert (np.abs(sums.total.squares - sums.total.samples) < 5 * np.sqrt(2.0 * sums.total.samples)).all()


def test_impossible_messages() -> None:
    """Steps with an entry of ``heard`` that cannot be are left out, and counted."""
    run = simulate(law(**LAWS["hold"]))
    run.used[100, 2, 0] = 300  # of a later step
    live = watched(run)
    assert live.report().refused == {"impossible entry in heard": 1}
    assert 780 < live.evidence.count <= 798  # some wait for its value, which never comes


@pytest.mark.parametrize("name", ["everything", "hold", "real time"])
def test_a_run_that_ends_early(name: str) -> None:
    """What agents do after the end is not a part of the run."""
    run = simulate(law(**LAWS[name]))
    live = LiveEstimate(run.record)
    live.end_at(500)
    report = watch(live, messages_of(run))
    assert (live.evidence.count, report.newest) == (500, 500)


def test_the_path_of_the_network() -> None:
    """Against counts of the graph of every step, whatever is known when; one period is missing, one comes twice."""
    rng = np.random.default_rng(4)
    lengths, graphs = rng.integers(1, 9, 300), rng.integers(0, 3, 300)
    ends = np.cumsum(lengths)
    path, counts, last, missing = NetworkPath(), np.zeros((3, 3), dtype=int), 0, 100
    for number, (end, length, graph) in enumerate(zip(ends.tolist(), lengths.tolist(), graphs.tolist(), strict=True)):
        assert all(path.add(end - length, end - 1, graph) for _ in range(0 if number == missing else 2))
        if rng.random() < 0.3 or end == ends[-1]:
            last = end - 1 if end == ends[-1] else max(last, int(rng.integers(max(0, end - 40), end + 5)))
            before, after, times = path.passed(last)
            np.add.at(counts, (before, after), times)
    every = np.repeat(graphs, lengths).astype(float)
    every[ends[missing] - lengths[missing] : ends[missing]] = np.nan
    wanted = [[int(((every[:-1] == a) & (every[1:] == b)).sum()) for b in range(3)] for a in range(3)]
    assert counts.tolist() == wanted


def test_a_contradiction_in_the_path() -> None:
    path = NetworkPath()
    assert [path.add(0, 3, 1), path.add(0, 4, 1)] == [True, False]


@pytest.mark.parametrize("noise", [{"link": 1.0}, {"link": 1.0, "loss": 0.2}, {"loss": 0.5}], ids=str)
def test_the_first_message_has_one_noise_and_one_loss(noise: dict[str, float]) -> None:
    """It is used in the steps 0..20. False alarms: at most 1 in 100 runs, with fixed seeds: none of 20."""
    changes = {"noise": {"process": 0.3, "delay": 20, **noise}, "run": {"replicas": 50, "start": "zero"}}
    prediction = predict(law(1.5, **changes))
    for seed in range(20):
        experiment = law(1.5, seed, **changes)
        sums = whole_sums(simulate(experiment), prediction.for_run(experiment))
        assert sums.evidence() < np.log(100.0), seed
