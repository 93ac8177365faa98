"""Killed agents and switchers are started again, rejoin, and change nothing. That is the default."""

import html
import random
import re
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from other_package import SLOW, install

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.run.result import read_steps
from msg_agents.run.supervisor import STEPS

FAULTS = [["agent"] * 3, ["switcher"], ["agent", "switcher"]]  # one agent: with the fork server, and below
RUN = {"duration": 120, "start": "zero", "processes": 3}  # 10 s, in the middle of which each fault happens
KILLED = r"(agents?_\w+|switcher): killed by SIGKILL.*, started again$"
LISTENER = """
import os, signal, struct, sys, rclpy
from msg_agents_interfaces.msg import AgentState
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
newest, repeated, ending = -1, 0, False
def end(*_):
    global ending
    ending = True
def hear(data):
    global newest, repeated
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    stamp = seconds * 10**9 + nanoseconds
    repeated, newest = repeated + (stamp <= newest), max(newest, stamp)
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGTERM, end)
node = rclpy.create_node("listener")
quality = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
for agent in range(1, 6):  # the run awaits a reader of all states
    listen = hear if agent == int(sys.argv[1]) else lambda _: None
    node.create_subscription(AgentState, f"/agent_{agent}/state", listen, quality, raw=True)
while not ending:
    rclpy.spin_once(node, timeout_sec=0.1)
print(newest, repeated, flush=True)
os._exit(0)  # the middleware may hang when it is taken down
"""


def wait_for_all(network: Any) -> None:
    """Until all processes of a run as ``RUN`` are there."""
    network.wait_for(lambda: len(network.nodes()) == RUN["processes"] + 2, 60, "all processes")


def wait_for_more(network: Any, steps: Path, more: int) -> None:
    """Until every agent has made so many steps more than the first one has now; a run knows of steps within 0.3 s."""
    reached = max(read_steps(steps), default=0)
    network.wait_for(lambda: min(read_steps(steps), default=0) > reached + more, 60, "steps of all")


@pytest.mark.timeout(300)
def test_killed_and_back(network: Any, repetition: int, rng: random.Random, monkeypatch: pytest.MonkeyPatch) -> None:
    """At any moment from the birth of the processes on: all of a fault at once, or also who has just come back."""
    # The faults happen in any order, each when all are back from the one before it. The fork server is killed at last:
    # what it has forked goes on; an agent is started without it.
    protocol = install("slow", SLOW, network.directory, monkeypatch)
    monkeypatch.syspath_prepend(network.directory / "packages")
    file, kills = network.file(protocol=protocol, run=RUN), sum(map(len, FAULTS)) + 1
    run = network.start("run", file, "--out", network.directory / "runs", "--json", "--restarts", str(kills))
    wait_for_all(network)
    steps = network.run_file().with_name(STEPS)
    for number, kinds in enumerate(rng.sample(FAULTS, len(FAULTS))):
        early, again = number == 0 and repetition > 0 and rng.random() < 0.3, rng.random() < 0.5
        if early:
            time.sleep(rng.uniform(0.0, 0.3))
        else:
            wait_for_more(network, steps, rng.randrange(50, 400))
        for kill, kind in enumerate(kinds):
            if again and kill:
                time.sleep(rng.uniform(0.0, 0.5))
            victim = rng.choice(network.wait_for(lambda kind=kind: network.processes(kind), 30, f"a living {kind}"))
            print("killed", "early" if early else "in the middle", victim.command[2:])
            victim.kill()
        wait_for_all(network)
    wait_for_more(network, steps, 50)
    (server,) = network.processes("node_server")
    server.kill()
    victim = network.processes("agent")[0]
    victim.kill()

    def back() -> Any:
        return [p for p in network.processes("agent") if p.agent == victim.agent and p != victim]

    (again,) = network.wait_for(back, 30, "the agent again")
    assert "msg_agents" in again.command  # python -m msg_agents agent ...
    result = network.completed(run)
    # One that has been killed with others may be killed again before it is back.
    assert len(FAULTS) + 1 <= len(result["restarts"]) <= kills
    assert all(re.match(KILLED, line) for line in result["restarts"])
    report = html.unescape(Path(result["report"]).read_text())
    assert all(line in report for line in result["restarts"])
    assert [one["words"] for one in result["events"] if one["kind"] == "killed"] == result["restarts"]


def test_budget(network: Any) -> None:
    """One kill more than allowed: a clear end that names who and how often."""
    file = network.file(run={"duration": 10_000, "processes": 2})
    run = network.record(file, "--restarts", "1")
    network.wait_for_steps()
    first = network.processes("agent")
    first[0].kill()
    network.wait_for(lambda: {p.pid for p in network.processes("agent")} - {p.pid for p in first}, 30, "the next one")
    network.processes("switcher")[0].kill()
    _, stderr = network.ended(run, 3)
    (line,) = re.findall(r"^note: (agents_\w+): killed by SIGKILL.*, started again$", stderr, re.MULTILINE)
    assert re.search(
        rf"^failed: switcher: killed by SIGKILL.*all restarts are used up \(--restarts 1\): {line} once$",
        stderr,
        re.MULTILINE,
    ), stderr


def test_who_comes_back_repeats_only_what_peers_may_lack(network: Any) -> None:
    """Not the thousands of states that it keeps, neither by itself nor for latched requests of earlier restarts."""
    # Restarts are allowed by default.
    file = network.file(run={"duration": 200, "processes": 5})
    with free_domain() as domain:
        run = network.record(file, "--domain", str(domain), "--await", "listener", "--json")
        network.wait_for(lambda: len(network.processes("agent")) == 5, 60, "all agents")
        victims = {process.agent: process for process in network.processes("agent")}
        steps = network.run_file().with_name(STEPS)
        command = [sys.executable, "-P", "-c", LISTENER, "3"]
        listener = subprocess.Popen(command, env=node_environment(domain), stdout=subprocess.PIPE, text=True)
        with listener, ExitStack() as stack:
            stack.callback(listener.kill)  # or it would be waited for, whatever has failed
            for victim in (victims[2], victims[3]):
                wait_for_more(network, steps, 300)
                victim.kill()
                network.wait_for(lambda victim=victim: not victim.alive, 10, "its end")
            wait_for_more(network, steps, 300)
            result = network.completed(run)
            listener.terminate()
            newest, repeated = map(int, listener.stdout.read().split())
    assert len(result["restarts"]) == 2
    assert newest > 0
    # Once by itself, once for the latched request, and for each neighbour that asks meanwhile: at most 66 states each
    # time, and none where the listener finds it later.
    assert repeated <= 5 * 66
