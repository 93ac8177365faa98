"""How far long work is."""

from __future__ import annotations

from pathlib import Path

import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.cli.console import SweepProgress, WorkProgress
from msg_analysis.common.resources import tell, watched
from msg_analysis.common.text import duration_text
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.verdict import compare
from msg_analysis.twin.simulate import simulate


def test_what_is_told(tmp_path: Path) -> None:
    """Every stage from 0 on, never beyond its end; nobody is told outside."""
    run = simulate(
        Experiment.parse(
            {
                "name": "net",
                "graphs": {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 1}}},
                "agents": 3,
                "switching": {"generator": [[-1, 1], [1, -1]]},
                "run": {"dt": 0.1, "duration": 200},
            }
        )
    )
    write_trajectory(run, tmp_path / "bag")
    told: dict[str, list[tuple[int, int]]] = {}
    with watched(lambda what, done, total: told.setdefault(what, []).append((done, total))):
        compare(read_bag(tmp_path / "bag"))
    tell("nothing", 1, 2)
    stages = ["reading bag", "reading bag_0.mcap", "errors", "errors given the path", "innovations"]
    assert list(told) == stages
    for steps in told.values():
        assert all(0 <= done <= total for done, total in steps)
        assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_short_work_shows_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with WorkProgress() as progress, watched(progress):
        tell("reading", 1, 2)
    assert capfd.readouterr() == ("", "")


def test_long_work_says_how_far_it_is(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A line every ten seconds where there is no terminal."""
    now = [100.0]
    monkeypatch.setattr("msg_analysis.cli.console.time.monotonic", lambda: now[0])
    with WorkProgress() as progress, watched(progress):
        for second in range(25):
            now[0] = 100.0 + second
            tell("reading x.mcap", second, 25)
    assert capfd.readouterr().err == "reading x.mcap: 40 %\nreading x.mcap: 80 %\n"


def test_a_sweep_says_what_is_left(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """At the mean speed of what is new: 40 of 100 points were there before, each takes a second and a half."""
    now = [100.0]
    monkeypatch.setattr("msg_analysis.cli.console.time.monotonic", lambda: now[0])
    with SweepProgress("sweep") as progress:
        progress.done(40, 100, 0)
        for done in range(41, 101):
            now[0] = 100.0 + 1.5 * (done - 40)
            progress.done(done, 100, int(done > 60))
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "sweep: 47 of 100, 10 s so far, 1 min 20 s left"
    assert lines[2] == "sweep: 61 of 100, 1 without a result, 32 s so far, 59 s left"
    assert lines[-1] == "sweep: 96 of 100, 1 without a result, 1 min 24 s so far, 6 s left"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0 s"), (57.4, "57 s"), (59.6, "1 min 0 s"), (3599, "59 min 59 s"), (7512, "2 h 5 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text
