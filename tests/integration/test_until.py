"""Runs that end before their duration, in order: each is complete, equal to its twin, and says how it ended."""

import json
import math
import random
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from networks import assert_equal_to_twin

from msg_agents.recovery import StopFiles
from msg_agents.run.result import conclude
from msg_agents.watch import observer as watching
from msg_agents.watch.observer import RunObserver
from msg_analysis.bags.reading import read_bag
from msg_analysis.inference import online_errors
from msg_analysis.model.run_record import Until

LONG = {"duration": 2000, "replicas": 8, "processes": 2}  # 40,000 steps
PLANNED = 40_000


def start(network: Any, until: str, *options: str, **changes: Any) -> Any:
    """A run to a precision, without a report: nobody looks at that."""
    file, out = network.file(**changes), network.directory
    quiet = ("--json", "--write-report", "never")
    return network.start("run", file, "--out", out, *quiet, "--until", until, *options)


def ended(result: dict[str, Any], planned: int = PLANNED) -> int:
    """The step at which a run ended, before the planned one, as result, run record and bag say it."""
    until, record = result["until"], read_bag(result["bag"]).record
    assert until["ended_early"]
    assert until["planned_steps"] == planned == record.planned_steps
    step: int = until["step"]
    assert 0 < step < planned
    assert record.experiment.steps == step == record.planned_steps - (planned - step)
    return step


def says_so(network: Any, result: dict[str, Any], until: str) -> None:
    """Result, notes, and the bag alone say how the run ended, at which step and why."""
    step, words = ended(result), f"precision {until.removesuffix('%')} % reached at step "
    assert result["steps"] == step
    assert result["until"]["reason"].startswith(words)
    assert int(result["until"]["reason"].rsplit(" ", 1)[1]) <= step
    assert any(note.startswith(f"--until {until}: {words}") for note in result["notes"])
    shown, _ = network.start("compare", result["bag"], program="msg-analysis").communicate(timeout=60)
    assert f"The run ended in order at step {step} of {PLANNED}: --until {until}." in shown


AIR = {"process": 1.0, "loss": 0.2, "link": 0.1, "broadcast": 0.1}
HOLD = {"process": 1.0, "loss": 0.2, "on_loss": "hold"}


@pytest.mark.parametrize(("noise", "restarts"), [(AIR, "3"), (HOLD, "0")], ids=["air", "hold"])
def test_ends_at_a_precision(network: Any, noise: dict[str, Any], restarts: str) -> None:
    """Without restarts, states are kept for the observer nevertheless. (Plain links, delayed messages: below.)"""
    says_so(network, network.completed(start(network, "30%", "--restarts", restarts, noise=noise, run=LONG)), "30%")


def test_real_time(network: Any) -> None:
    run = {"pace": "realtime", "speed": 20, "duration": 4000, "replicas": 8, "processes": 2}
    result = network.completed(start(network, "30%", run=run))
    assert ended(result, 80_000) == result["steps"]


def test_no_record(network: Any) -> None:
    """Without a bag, and restarts, the result says how the run ended, and nothing is left."""
    result = network.result(start(network, "40%", "--restarts", "0", "--no-record", run=LONG))
    assert (result["until"]["ended_early"], result["bag"], result["failures"]) == (True, None, [])
    assert [path.name for path in network.directory.iterdir()] == ["net.yaml"]


def test_not_reached(network: Any) -> None:
    result = network.completed(start(network, "0.1%", run={"duration": 50, "processes": 2}))
    assert (result["until"]["ended_early"], result["steps"]) == (False, 1000)
    assert result["until"]["reason"].startswith("not reached: precision ")


def test_killed_processes(network: Any, repetition: int, rng: random.Random) -> None:
    """An agent and the switcher are killed and come back, before or after the end is announced; with a delay."""
    run = start(network, "25%", "--restarts", "9", noise={"process": 1.0, "delay": 2}, run=LONG)
    network.wait_for(lambda: network.recorded_bytes(".") > 50_000, 60, "recorded states")
    for kind in rng.sample(["agent", "switcher", "switcher"], 3):
        there = network.processes(kind)
        if there:
            rng.choice(there).kill()
        try:
            run.wait(rng.uniform(0.2, 1.5))
            break
        except subprocess.TimeoutExpired:
            continue
    says_so(network, network.completed(run), "25%")


def test_evidence_ends_a_run_whose_switcher_is_killed(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The observer is told of a law with a third of the noise: ``decided`` ends the run by the evidence against it."""
    # The switcher is killed when it has announced the end; the next one announces the same step.
    experiment = network.experiment(run=LONG)
    other = network.experiment(run=LONG, noise={"process": 0.6})
    announced = []

    def observer(record: Any, checkpoints: Path) -> RunObserver:
        return RunObserver(replace(record, experiment=other), checkpoints)

    def kill(files: Any) -> int | None:
        step = found(files)
        if step is not None and not announced:
            announced.append(step)
            for process in network.processes("switcher"):
                process.kill()
        return step

    found = StopFiles.decided
    monkeypatch.setattr(watching, "RunObserver", observer)
    monkeypatch.setattr(StopFiles, "decided", kill)
    result = network.run(experiment, until=Until.parse("decided"))
    assert_equal_to_twin(result.trajectory)
    assert result.until["reason"].startswith("evidence against the prediction passed 100 at step ")
    assert result.until["ended_early"]
    assert [result.until["step"]] == announced == [result.trajectory.record.experiment.steps]
    conclude(result, "never")
    assert result.comparison.verdict == "agrees"  # with its own law


def test_is_watched_to_its_end(network: Any, domain: int) -> None:
    """On plain links, with a process per agent: while it runs, and when its bag in two files is played again."""
    # The watcher knows where it ends.

    def watched(other: Any) -> dict[str, Any]:
        stdout, stderr = live.communicate(timeout=100)
        assert live.returncode == 0, stderr
        assert other.wait(100) == 0
        found: dict[str, Any] = json.loads(stdout)
        return found

    live = network.start("live", "--reliable", "--json", "--timeout", "60")
    alone = LONG | {"processes": "one_per_agent"}
    # A watcher that is not awaited may find the run late, and on a busy machine miss its end.
    run = start(network, "30%", "--split-size", "1", "--domain", str(domain), "--await", "live", run=alone)
    result = network.completed(run)
    says_so(network, result, "30%")
    assert result["any_time"]["half_width"] <= 0.31 * result["system_error"]["measured"]
    assert watched(run)["last_step"] >= result["steps"] - 1  # an agent may have gone a little further
    live = network.start("live", "--reliable", "--json", "--timeout", "60")
    found = watched(network.start("play", result["bag"], "--rate", "max", "--await", "live"))
    assert (found["first_step"], found["missing"]) == (0, 0)
    assert found["any_time"]["log_evidence"] < math.log(100)
    assert found["any_time"]["half_width"] == pytest.approx(result["any_time"]["half_width"], rel=0.05)


def test_network_of_a_sweep(network: Any) -> None:
    file = network.directory / "rates.yaml"
    over = {"run.replicas": [8]}
    sweep = {"experiment": network.experiment(run=LONG).to_document(), "over": over, "kind": "network", "until": "30%"}
    file.write_text(yaml.safe_dump(sweep))
    command = ("sweep", file, "--json", "--out", network.directory / "out")
    stdout, stderr = network.start(*command, program="msg-analysis").communicate(timeout=150)
    points = json.loads(stdout)["points"]
    assert [point["status"] for point in points] == ["done"], stderr
    assert all(500 < point["steps"] < PLANNED for point in points)


@pytest.mark.parametrize("error", [MemoryError("too little"), ZeroDivisionError("a fault")])
def test_observer_fails(network: Any, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """The run goes on to its planned end, and says that it was not watched."""

    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(online_errors.LiveEstimate, "report", fail)
    four_seconds = {"pace": "realtime", "duration": 20, "speed": 5.0}  # the errors are looked at once a second
    result = network.run(network.experiment(run=four_seconds | {"processes": 2}), until=Until(0.5))
    assert_equal_to_twin(result.trajectory)
    assert len(result.trajectory.modes) == 400
    assert not result.until["ended_early"]
    assert result.until["reason"].startswith(
        f"not known: the errors cannot be followed any more ({type(error).__name__}"
    )


def test_too_late(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 40 steps, agents can be at the end before they know of an earlier one: the run stays whole."""
    monkeypatch.setattr(online_errors, "reached", lambda *_: "precision 50 % reached at step 1")
    result = network.run(network.experiment(run={"duration": 2}), until=Until(0.5))
    assert_equal_to_twin(result.trajectory)
    assert len(result.trajectory.modes) == 40
    assert not result.until["ended_early"]
