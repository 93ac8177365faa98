"""``msg-agents doctor --network``: equal networks, one that is made unequal, and interrupted ones."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path
from typing import Any

from msg_agents.cli.nodes import load_record
from msg_agents.doctor.networks.fault_plan import plan_faults
from msg_agents.doctor.networks.random_networks import random_document
from msg_agents.recovery.checkpoint import Checkpoint, entry_size
from msg_analysis.bags.reader import read_bag
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.twin.check import check

SMALL = 3468, 3469  # in each, the process of an agent is killed before the first step
UNDISTURBED = 225  # six agents in two processes, 3,474 steps, no noise on the air


def start(network: Any, count: int, first_seed: int) -> Any:
    out = network.directory / "runs"
    options = ("--networks", count, "--first-seed", first_seed, "--out", out)
    return network.start("doctor", "--network", "--json", *map(str, options))


def finished(doctor: Any) -> tuple[int, dict[str, Any], str]:
    """Exit code, result, and what was said on the way."""
    stdout, stderr = doctor.communicate(timeout=120)
    assert "Traceback" not in stderr, stderr
    return doctor.returncode, json.loads(stdout), stderr


def undisturbed_process(network: Any) -> Any:
    """One of a network that meets no faults, with its checkpoint and the length of a state in it."""
    experiment = ValidExperiment.parse(random_document(UNDISTURBED))
    assert plan_faults(UNDISTURBED, experiment.agents, experiment.steps).faults == ()
    assert not experiment.noise.on_air
    process = network.wait_for(lambda: network.processes("agent"), 60, "an agent")[0]
    size = entry_size(load_record(network.run_file()))

    def checkpoint() -> Checkpoint | None:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        found = re.search(rf"/\S+/agent_{process.agent}\.states$", maps, re.MULTILINE)
        return Checkpoint(Path(found[0]), size) if found else None

    return process, network.wait_for(checkpoint, 60, "its checkpoint")


def test_equal(network: Any) -> None:
    code, result, stderr = finished(start(network, 2, SMALL[0]))
    assert (code, result["good"], result["equal"]) == (0, True, 2), (result, stderr)
    assert "failed" not in stderr
    for seed, found in zip(SMALL, result["networks"], strict=True):
        experiment = ValidExperiment.parse(random_document(seed))
        states = experiment.agents * (experiment.steps + 1)
        assert (found["seed"], found["status"], found["agents"]) == (seed, "equal", experiment.agents)
        assert found["compared"] in (states, 2 * states)  # also what was published, where that is something else
        planned = [fault.to_json() for fault in plan_faults(seed, experiment.agents, experiment.steps).faults]
        assert [fault for fault in found["faults"] if fault not in planned] == []
        assert len(found["restarts"]) == sum(fault["stopped"] is None for fault in found["faults"]) == 1
    assert not (network.directory / "runs").exists()


def test_one_bit(network: Any) -> None:
    """Of a state from which a killed agent goes on: found, kept, and found again in what was kept."""
    doctor = start(network, 1, UNDISTURBED)
    process, checkpoint = undisturbed_process(network)
    network.wait_for(lambda: len(checkpoint.read()) > 100, 60, "some steps")
    process.kill(signal.SIGSTOP)
    step, message = checkpoint.read()[-1]
    checkpoint.write(step, message[:-6] + bytes([message[-6] ^ 1]) + message[-5:])  # a bit that no rounding hides
    process.kill()
    code, result, stderr = finished(doctor)
    assert (code, result["good"], result["differs"]) == (1, False, 1), (result, stderr)
    (found,) = result["networks"]
    assert re.search(r"at step \d+, replica \d+: logged \S+, the law gives ", found["text"])
    kept = Path(found["folder"])
    assert kept.parent == network.directory / "runs"
    again = f"msg-agents doctor --network --networks 1 --first-seed {UNDISTURBED}"
    assert f"failed: network {UNDISTURBED}: {found['text']} (kept in {kept}, again: {again})" in stderr
    assert json.loads((kept / "experiment.json").read_text()) == random_document(UNDISTURBED)
    assert json.loads((kept / "outcome.json").read_text()) == found
    assert list((kept / "log").glob("*.log"))
    assert check(read_bag(kept)).difference == found["text"]


def test_interrupted(network: Any, repetition: int) -> None:
    """In the middle of the first network: no result, and nothing is left."""
    number = signal.SIGTERM if repetition % 2 else signal.SIGINT
    doctor = start(network, 9, UNDISTURBED)
    _, checkpoint = undisturbed_process(network)
    network.wait_for(lambda: len(checkpoint.read()) > 100, 60, "some steps")
    doctor.send_signal(number)
    stdout, stderr = doctor.communicate(timeout=60)
    assert (doctor.returncode, stdout) == (128 + number, ""), stderr
    assert "Traceback" not in stderr
    assert network.processes() == []
    assert not (network.directory / "runs").exists()
