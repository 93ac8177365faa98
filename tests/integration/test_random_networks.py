"""Random networks with random faults: equal to their twins. One whose checkpoint is made wrong is found."""

import re
import signal
from pathlib import Path
from typing import Any

import yaml
from random_faults import plan_faults, run_random_network
from random_networks import random_document

from msg_agents.cli.nodes import load_record
from msg_agents.recovery import Checkpoint, entry_size
from msg_analysis.bags.reading import read_bag
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.check import check

KILLED = 3468  # the process of an agent is killed before the first step
UNDISTURBED = 225  # six agents in two processes, 3,474 steps, no noise on the air


def test_equal(network: Any, repetition: int) -> None:
    seed = KILLED + repetition
    result, met, verdict = run_random_network(seed, network.directory / "runs")
    assert verdict.status in ("equal", "ended"), (seed, verdict, met, result.bag)
    experiment = Experiment.parse(random_document(seed))
    assert set(met.faults) <= set(plan_faults(seed, experiment.agents, experiment.steps).faults)
    assert len(result.restarts) <= sum(fault.kills for fault in met.faults)
    first = repetition == 0  # then it is known what happens, and nothing is missing
    states = experiment.agents * (experiment.steps + 1)
    assert not first or verdict.status == "equal", verdict
    assert not first or verdict.compared in (states, 2 * states)  # with what was published, if that is something else
    assert not first or len(result.restarts) == sum(fault.kills for fault in met.faults) == 1


def test_one_bit(network: Any) -> None:
    """Of a state from which a killed agent goes on: found."""
    experiment = Experiment.parse(random_document(UNDISTURBED))
    assert not experiment.noise.on_air
    file = network.directory / "network.yaml"
    file.write_text(yaml.safe_dump(random_document(UNDISTURBED)))
    run = network.record(file)
    process = network.wait_for(lambda: network.processes("agent"), 60, "an agent")[0]
    size = entry_size(load_record(network.run_file()))

    def checkpoint() -> Checkpoint | None:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        found = re.search(rf"/\S+/agent_{process.agent}\.states$", maps, re.MULTILINE)
        return Checkpoint(Path(found[0]), size) if found else None

    states = network.wait_for(checkpoint, 60, "its checkpoint")
    network.wait_for(lambda: len(states.read()) > 100, 60, "some steps")
    process.kill(signal.SIGSTOP)
    step, message = states.read()[-1]
    states.write(step, message[:-6] + bytes([message[-6] ^ 1]) + message[-5:])  # a bit that no rounding hides
    process.kill()
    run.communicate(timeout=120)
    bag = network.bag()
    assert re.search(r"at step \d+, replica \d+: logged \S+, the law gives ", check(read_bag(bag)).difference or "")
