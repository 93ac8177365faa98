"""How far long work is."""

from __future__ import annotations

from pathlib import Path

import pytest

from msg_analysis.bags.reader import read_bag
from msg_analysis.bags.trajectory_writer import write_trajectory
from msg_analysis.cli.progress import WorkProgress
from msg_analysis.common.long_work import tell, watched
from msg_analysis.inference.verdict.compare import compare
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.twin.simulate import simulate


def test_what_is_told(tmp_path: Path) -> None:
    """Every stage from 0 on, never beyond its end; nobody is told outside."""
    run = simulate(
        ValidExperiment.parse(
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
    assert list(told) == ["reading bag", "reading bag_0.mcap", "errors", "errors given the path", "innovations"]
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
    monkeypatch.setattr("msg_analysis.cli.progress.time.monotonic", lambda: now[0])
    with WorkProgress() as progress, watched(progress):
        for second in range(25):
            now[0] = 100.0 + second
            tell("reading x.mcap", second, 25)
    assert capfd.readouterr().err == "reading x.mcap: 40 %\nreading x.mcap: 80 %\n"
