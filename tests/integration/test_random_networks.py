"""Random networks with random faults: equal to their twins. One whose checkpoint is made wrong is found."""

import contextlib
import random
import re
import signal
import time
from pathlib import Path
from typing import Any

import yaml
from random_networks import random_document

from msg_agents.cli.nodes import load_record
from msg_agents.recovery import Checkpoint, entry_size
from msg_agents.run.result import read_steps
from msg_agents.run.supervisor import STEPS
from msg_analysis.bags.reading import read_bag
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.check import check

KILLED = 3468  # the process of an agent is killed before the first step
UNDISTURBED = 225  # six agents in two processes, 3,474 steps, no noise on the air


def written(network: Any, seed: int) -> tuple[Path, int]:
    """A file with the experiment of a seed; its number of steps."""
    file = Path(network.directory / "network.yaml")
    file.write_text(yaml.safe_dump(random_document(seed)))
    return file, Experiment.load(file).steps


def test_equal(network: Any, repetition: int, rng: random.Random) -> None:
    """Up to three processes are killed or stopped, each at any moment: the run is complete and equal to its twin."""
    file, steps = written(network, KILLED + repetition)
    run = network.record(file, "--restarts", "3", "--json")
    network.wait_for(lambda: network.processes("agent", "switcher"), 60, "a process")
    reached = network.run_file().with_name(STEPS)
    killed: list[str] = []
    for number in range(rng.randint(1, 3)):
        # In the first network, who is killed has made no step yet.
        moment = rng.randrange(round(0.7 * steps)) if number or repetition else -1
        network.wait_for(lambda moment=moment: run.poll() is not None or _slowest(reached) >= moment, 100, "a step")
        victims = network.processes("agent", "switcher")
        if not victims:
            break  # it is over
        victim = rng.choice(victims)
        print("at step", moment, victim.command[2:])
        if number == 0 or rng.random() < 0.5:
            killed.append(victim.kind)
            victim.kill()
        else:
            victim.kill(signal.SIGSTOP)
            time.sleep(rng.uniform(0.05, 1.5))
            victim.kill(signal.SIGCONT)
    restarts = network.completed(run)["restarts"]
    assert all(": killed by SIGKILL" in line for line in restarts)
    assert (1 if repetition == 0 else 0) <= len(restarts) <= len(killed)


def _slowest(steps: Path) -> int:
    """Step of the last agent; a run that is over has no such file any more."""
    with contextlib.suppress(OSError):
        return min(read_steps(steps), default=-1)
    return -1


def test_one_bit(network: Any) -> None:
    """Of a state from which a killed agent goes on: found."""
    run = network.record(written(network, UNDISTURBED)[0])
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
