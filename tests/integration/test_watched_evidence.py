"""Evidence while a real network runs: that of the comparison, for all laws; a wrong network is ended and named."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from tests.support.watched_run import whole_sums

from msg_agents.watch import observer as watching
from msg_agents.watch.observer import RunObserver
from msg_analysis.bags.reading import read_bag
from msg_analysis.model.run_record import Until
from msg_analysis.theory.prediction import predict

AIR = {"process": 1.0, "loss": 0.2, "link": 0.2, "broadcast": 0.2}
LAWS: dict[str, dict[str, Any]] = {
    "loss and noise": {"noise": AIR},
    "hold, delay": {"noise": {"process": 1.0, "loss": 0.2, "on_loss": "hold", "delay": 1}},
    "real time": {"run": {"pace": "realtime", "speed": 10}},
    "real time, loss and noise": {"noise": AIR, "run": {"pace": "realtime", "speed": 10}},
}

# Agent 3 has 1.3 times its noise in every process of the run; the record does not know it.
NOISY = """
from msg_analysis.model import agent_law

class Noisy(agent_law.ProcessNoise):
    def block(self, agent, *others):
        return [noise * (1.3 if agent == 2 else 1.0) for noise in super().block(agent, *others)]

agent_law.ProcessNoise = Noisy
"""


@pytest.mark.parametrize("law", LAWS)
def test_watchers_have_the_evidence_of_the_comparison(
    network: Any, domain: int, law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The observer of the run by the checkpoints, and `live` by the topics of its replay."""
    observers: list[RunObserver] = []

    def observer(record: Any, checkpoints: Path) -> RunObserver:
        observers.append(RunObserver(record, checkpoints))
        return observers[-1]

    monkeypatch.setattr(watching, "RunObserver", observer)
    changes = LAWS[law]
    experiment = network.experiment(**changes | {"run": {"duration": 10, "processes": 2} | changes.get("run", {})})
    result = network.run(experiment, until=Until(0.001))
    assert (result.failures, result.until["ended_early"]) == ([], False)
    record = result.trajectory.record
    wanted = whole_sums(result.trajectory, predict(record.experiment, record.step_model)).evidence()
    report = observers[0].report
    assert observers[0]._reader.missed == 0
    assert report.any_time.log_evidence == pytest.approx(wanted, abs=1e-7)
    live = network.start("live", "--reliable", "--json", "--timeout", "60")
    play = network.start("play", result.bag, "--rate", "max", "--await", "live")
    stdout, stderr = live.communicate(timeout=100)
    assert (play.wait(60), live.returncode) == (0, 0), stderr
    found = json.loads(stdout)
    assert found["refused"] == {}
    assert found["any_time"]["log_evidence"] == pytest.approx(wanted, abs=1e-7)


@pytest.mark.parametrize("law", ["plain", "loss and noise", "real time"])
def test_a_wrong_network_is_ended(network: Any, law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its agents do not what the record says: the run ends early, disagrees, and says why."""
    (network.directory / "sitecustomize.py").write_text(NOISY)
    changes = LAWS.get(law, {})
    file = network.file(**changes | {"run": {"duration": 4000, "replicas": 8, "processes": 2} | changes.get("run", {})})
    options = ("--out", network.directory, "--json", "--until", "decided", "--write-report", "never")
    monkeypatch.setenv("PYTHONPATH", str(network.directory), prepend=os.pathsep)  # of the processes of agents
    run = network.start("run", file, *options)
    result = network.result(run, 1)
    assert (result["verdict"], result["failures"]) == ("disagrees", [])
    assert result["until"]["ended_early"]
    assert result["until"]["reason"].startswith("evidence against the prediction passed 100 at step ")
    assert result["any_time"]["exceeded"]
    assert result["any_time"]["questions"][0]["about"] == "noise of agent 3"
    cause = result["causes"][0]  # over the whole run, or in a stretch that is clearer
    assert (cause["kind"], cause["agent"]) == ("noise", 3), cause
    assert 1.0 < cause["estimate"] < 2.0, cause
    trajectory = read_bag(result["bag"])
    assert trajectory.completeness.complete
    assert trajectory.record.experiment.steps == result["until"]["step"] == result["steps"]
