"""Networks in real time: every agent on its own timer, with the newest values that it has.

What depends on timing is not asserted; what the log says of it must be possible, and the states must be what the law
makes of it, to the last bit.
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest
from networks import assert_equal_to_twin, run_file
from set_clock import SetClock
from started_processes import started_processes

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.run.result import read_steps
from msg_analysis.bags.reading import read_bag
from msg_analysis.inference.pool import compare
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import phases

# 100 steps a second for 4 s, and for 2 s where nobody is killed or stopped in the middle.
REALTIME = {"pace": "realtime", "speed": 5, "dt": 0.05, "duration": 20}
UNDISTURBED = REALTIME | {"duration": 10}
TICK = 20_000_000  # ns by which the clock below moves on, every 10 ms of the wall
# Publishes a clock of its own: twice as fast as the wall, with a pause of a second after every one and a half.
CLOCK = f"""
import time
import rclpy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

rclpy.init()
node = rclpy.create_node("clock", enable_rosout=False)
publisher = node.create_publisher(Clock, "/clock", 10)
for tick in range(100_000):
    publisher.publish(Clock(clock=Time(nanoseconds=1000_000_000_000 + tick * {TICK}).to_msg()))
    time.sleep(1.0 if tick % 150 == 149 else 0.01)
"""


def assert_possible(trajectory: Run) -> None:
    """Complete, equal to its replay, and stamped as it can be."""
    assert_equal_to_twin(trajectory)
    assert trajectory.completeness.out_of_order == 0
    assert trajectory.completeness.refused == {}
    assert trajectory.completeness.expected == trajectory.states[..., 0].size
    experiment, used, made = trajectory.record.experiment, trajectory.used, trajectory.made
    assert (made[0] == 0).all()
    assert (np.diff(made, axis=0) > 0).all()
    due = (np.arange(experiment.steps)[:, None] + phases(experiment)) * experiment.step_length * 1e9
    assert (made[1:] >= due - 1).all()
    assert (used <= experiment.steps).all()
    assert (used >= 0).any()
    assert not np.isnan(trajectory.states).any()


def test_one_process_per_agent(network: Any) -> None:
    """The verdict is one that a right run misses once in 10,000 times."""
    result = network.run(network.experiment(run={**UNDISTURBED, "processes": "one_per_agent"}))
    assert_possible(result.trajectory)
    assert compare(result.trajectory, level=1e-4, max_missed=1.0).verdict == "agrees"


def test_a_busy_machine_is_no_wrong_theory(network: Any) -> None:
    """Others keep every core busy. Whoever is late is said to be late; a false alarm comes once in 10,000 times."""
    with started_processes() as busy:

        def disturb(_: int) -> None:
            """As soon as agents make steps."""
            while len(busy) < 2 * (os.cpu_count() or 1):
                busy.append(subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]))

        result = network.run(network.experiment(run={**UNDISTURBED, "processes": 2}), on_progress=disturb)
        assert busy
    assert_possible(result.trajectory)
    comparison = compare(result.trajectory, level=1e-4, max_missed=1.0)
    assert comparison.verdict == "agrees"
    assert comparison.laws.pattern.supported
    assert comparison.timing.missed_share <= 0.01 or comparison.laws.sequential.supported is False


def test_holding_times_of_one_step(network: Any) -> None:
    """They are over before they arrive: agents go on with the next ones, and nothing is refused."""
    # Between two graphs of 1.3 steps on average, an agent that had missed one would have kept its graph for ever. With
    # two processes; the verdict as above.
    fast = {"switching": {"generator": [[-20.0, 20.0], [20.0, -20.0]]}}
    result = network.run(network.experiment(**fast, run={**UNDISTURBED, "speed": 10, "duration": 20, "processes": 2}))
    assert result.rejected_messages == []
    assert_possible(result.trajectory)
    assert compare(result.trajectory, level=1e-4, max_missed=1.0).verdict == "agrees"
    changes = np.diff(result.trajectory.agent_modes[1:], axis=0) != 0
    assert (changes.sum(axis=0) >= 20).all()  # of some 250; on a busy machine agents make many steps at once


def test_under_a_clock_of_somebody_else(network: Any) -> None:
    """All stamps are ticks of that clock, but for the nanoseconds by which what comes out of something is later."""
    speed = 2.5
    what = network.experiment(run={**REALTIME, "speed": speed, "duration": 12, "processes": 2})
    with free_domain() as domain, started_processes() as started:
        started.append(subprocess.Popen([sys.executable, "-P", "-c", CLOCK], env=node_environment(domain)))
        result = network.run(what, domain=domain, use_sim_time=True)
    assert_possible(result.trajectory)
    assert (result.trajectory.made % round(TICK * speed) < 10_000).all()


@pytest.mark.parametrize("option", [["--use-sim-time"], ["--ros-args", "-p", "use_sim_time:=true"]], ids=" ".join)
def test_without_a_clock(network: Any, option: list[str]) -> None:
    file = run_file(network.directory, 5, run=REALTIME)
    with free_domain() as domain:
        agents = [part for number in "12345" for part in ("--agent", number)]
        node = network.execute("agent", file, *agents, "--discovery-timeout", "1", *option, ROS_DOMAIN_ID=str(domain))
        stdout, stderr = node.communicate(timeout=60)
    assert (node.returncode, stdout) == (2, ""), stderr
    assert "did not discover: a publisher of /clock." in stderr


@pytest.mark.timeout(150)
def test_killed_and_back(network: Any, repetition: int) -> None:
    """An agent and the switcher are killed; whoever takes over keeps to the epoch and catches up."""
    rng = random.Random(f"realtime {repetition}")
    what = network.experiment(run={**REALTIME, "duration": 25, "replicas": 16, "processes": 3})

    def kill() -> None:
        network.wait_for_steps()
        for kind in ("agent", "switcher"):
            time.sleep(rng.uniform(0.0, 1.0))
            victims = network.wait_for(lambda kind=kind: network.processes(kind), 30, f"a living {kind}")
            rng.choice(victims).kill()

    killer = threading.Thread(target=kill)
    killer.start()
    result = network.run(what, restarts=3)
    killer.join()
    assert len(result.restarts) == 2
    assert_possible(result.trajectory)


@pytest.mark.timeout(150)
def test_an_agent_stands_still_and_the_clock_is_set_back(network: Any) -> None:
    """Each by three seconds: the run names it, and catches up; then, that no step is due, and waits."""
    # The clock is that of all processes of the run, whose log is possible.
    clock = SetClock(network.directory)
    # Of several agents in a process, that which stands still for the shorter time is told: here there is one.
    file = network.file(run=REALTIME | {"duration": 35, "processes": 3})
    run = network.execute(*network.recording(file), "--json", **clock.environment)
    steps = network.wait_for_steps()
    (agent,) = (process for process in network.processes("agent") if process.agent == 1)
    agent.kill(signal.SIGSTOP)
    time.sleep(3.0)
    agent.kill(signal.SIGCONT)
    network.wait_for(lambda: np.ptp(read_steps(steps) or [0, 999]) < 50, 30, "everybody at the same step")
    clock.set_ahead(-3.0)
    stdout, stderr = network.ended(run)
    assert re.search(
        r"note: agents? .*\(PID \d+\) ha(s|ve) made no step for [2-5]\.\d s; the other \d (is|are)", stderr
    )
    assert re.search(r"note: the clock of this machine was set back by 3\.0 s: no step is due", stderr)
    assert_possible(read_bag(json.loads(stdout)["bag"]))


OTHER_LAWS: dict[str, dict[str, Any]] = {
    "grounded": {"problem": "tracking", "leaders": {"agents": [1, 4], "gain": "inf", "reference": 2.0}},
    "discrete, correlated": {
        "time": "discrete",
        "switching": {"transition": [[0.9, 0.1], [0.4, 0.6]]},
        "noise": {"process": [[1.0 if i == j else 0.3 / (1 + i + 2 * j) for j in range(5)] for i in range(5)]},
        "run": {"dt": 1, "duration": 200, "speed": 100},
    },
}


def test_two_runs_at_the_same_time(network: Any) -> None:
    """Of other laws, each in one process, into one directory: they neither hear nor overwrite each other."""
    out, runs = network.directory / "runs", {}
    for seed, (law, changes) in enumerate(OTHER_LAWS.items(), start=1):
        run = {**UNDISTURBED, "processes": 1, **changes.get("run", {})}
        runs[law] = network.record(network.file(f"{law}.yaml", **{**changes, "run": run}), "--seed", str(seed))
    errors = [run.communicate(timeout=100)[1] for run in runs.values()]
    assert [run.returncode for run in runs.values()] == [0, 0]
    assert not any("Traceback" in text or "failed" in text for text in errors), errors
    trajectories = [read_bag(directory) for directory in sorted(out.iterdir())]
    assert {trajectory.record.experiment.run.seed for trajectory in trajectories} == {1, 2}
    for trajectory in trajectories:
        assert_possible(trajectory)
