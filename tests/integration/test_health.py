"""A network that stands still says where it waits; and then goes on. Second processes of its agents leave."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.run.result import read_steps
from msg_analysis.twin.simulate import new_record

# Prints every DiagnosticArray of /diagnostics, level and values included, a line each; to stderr what agents report.
MONITOR = """
import json, rclpy, sys
from diagnostic_msgs.msg import DiagnosticArray
from msg_agents_interfaces.msg import Progress

def say(array):
    statuses = [
        {"name": s.name, "level": s.level[0], "message": s.message, **{v.key: v.value for v in s.values}}
        for s in array.status
    ]
    print(json.dumps(statuses), flush=True)

rclpy.init()
node = rclpy.create_node("monitor", enable_rosout=False)
node.create_subscription(DiagnosticArray, "/diagnostics", say, 100)
node.create_subscription(Progress, "/progress", lambda m: print(m.agent, m.step, file=sys.stderr, flush=True), 100)
print("[]", flush=True)  # it listens
rclpy.spin(node)
"""


def statuses(file: Path) -> list[dict[str, Any]]:
    lines = file.read_text().splitlines(keepends=True)
    return [status for line in lines if line.endswith("\n") for status in json.loads(line)]


def heard_of(file: Path) -> set[str]:
    return {status["name"] for status in statuses(file)}


@pytest.mark.timeout(150)
def test_a_stopped_agent_and_second_processes_of_others(network: Any) -> None:
    """On /diagnostics, in the log of its neighbour, and to the user; then all goes on as if nothing had been."""
    # Meanwhile second processes of two agents, of the same run and of another one, find their names taken and leave;
    # the run says who was there.
    other = network.directory / "other.json"
    other.write_text(new_record(network.experiment(run={"duration": 100, "seed": 8})).to_json(with_key=True))
    heard, reports = network.directory / "heard", network.directory / "reports"
    with free_domain() as domain, heard.open("w") as output, reports.open("w") as errors:
        file = network.file(run={"duration": 600, "processes": "one_per_agent"})
        command = [sys.executable, "-P", "-c", MONITOR]
        monitor = subprocess.Popen(command, env=node_environment(domain), stdout=output, stderr=errors)
        try:
            # Before the run, which takes a few seconds.
            network.wait_for(heard.read_text, 30, "the monitor")
            run = network.record(file, "--domain", str(domain), "--json")
            network.wait_until_moving()
            network.wait_for(lambda: len(heard_of(heard)) == 7, 30, "diagnostics of every node")
            (victim,) = (process for process in network.processes("agent") if process.agent == 2)
            victim.kill(signal.SIGSTOP)  # the network stands still until they have left
            time.sleep(0.5)  # a run whose last step was already made ends meanwhile
            assert len(network.nodes()) == 7, "too fast to be stopped in the middle"
            environment = node_environment(domain)
            # What gets lost while they look for each other comes again after 3 s, and the same can happen to that.
            doubles = {
                agent: network.execute("agent", record, "--agent", agent, "--discovery-timeout", "12", **environment)
                for agent, record in (("4", network.run_file()), ("5", other))
            }

            log = network.run_file().with_name("agent_1.log")

            def complaints() -> list[str]:
                return re.findall(r"agent_1.*no step for \d+ s at step (\d+): waiting for (.*)", log.read_text())

            complaint = network.wait_for(complaints, 30, "the watchdog")
            # Before anybody goes on, since who has just gone on is not silent. A slow start is said in lines before it.
            note = next(line for line in run.stderr if line.startswith("note"))
            for agent, double in doubles.items():
                _, said = network.ended(double, 2)
                assert re.search(rf"more than one node was still called .*agent_{agent}.* in ROS_DOMAIN_ID", said), said
            victim.kill(signal.SIGCONT)
            result = network.completed(run)
        finally:
            monitor.kill()
            monitor.wait()
    assert result["restarts"] == []
    left = {"node": "switcher", "reason": "duplicate node name", "count": 1}
    names_taken = [left | {"topic": f"agent_{agent}"} for agent in doubles]
    assert all(entry in result["rejected_messages"] for entry in names_taken)
    # On a busy machine that of the other run may have begun before it finds its name taken.
    assert all(entry["reason"] == "other run" for entry in result["rejected_messages"] if entry not in names_taken)
    ((step, words),) = complaint
    assert words in (f"step {step} of agent 2", "too far behind: agent 2")
    assert reports.read_text().splitlines().count(f"1 {step}") >= 3  # it goes on saying where it stands
    for line in (note, *(f"note: {later}\n" for later in result["notes"])):  # said again while it stands still for long
        assert re.match(rf"note: no step for \d+ s: .*agent_1: at step {step}, waiting for {words}", line)
        assert line.endswith(f"; stopped, and waited for: agent_2 (PID {victim.pid})\n")

    known = statuses(heard)
    assert heard_of(heard) == {*(f"agent_{i}: network" for i in range(1, 6)), "switcher: network", "recorder: network"}
    agents = [status for status in known if status["name"].startswith("agent")]
    for status in agents:
        assert int(status["step"]) >= 0
        assert float(status["steps per second"]) >= 0
        waits = "waiting for" in status
        refused = any(key.startswith("refused on ") for key in status)  # of a second process
        assert status["level"] == (1 if waits or refused else 0)
        assert waits == ("waiting for" in status["message"])
    waited = {
        s["waiting for"] for s in agents if s["name"] == "agent_1: network" and s["step"] == step and "waiting for" in s
    }
    assert waited == {words}
    moving = [s for s in agents if re.fullmatch(r"at step \d+", s["message"]) and float(s["steps per second"]) > 0]
    assert moving


@pytest.mark.timeout(150)
def test_an_agent_that_was_not_given_the_end(network: Any) -> None:
    """It was stopped when the run ended: nothing is missing, so the run does not wait for it for ever."""
    file = network.file(run={"duration": 6, "speed": 2, "pace": "realtime", "processes": "one_per_agent"})
    run = network.record(file, "--json")
    steps = network.wait_for_steps()
    (recorder,) = network.processes("recorder")
    recorder.kill(signal.SIGSTOP)  # so the run does not end
    network.wait_for(lambda: min(read_steps(steps)) == 120, 60, "the last steps")
    (victim,) = (process for process in network.processes("agent") if process.agent == 2)
    victim.kill(signal.SIGSTOP)
    recorder.kill(signal.SIGCONT)
    notes = network.completed(run)["notes"]
    assert "agent_2 had not left 10 s after the end of the run: interrupted" in notes
    assert all("had not left" in words or "all steps are made, but no end for" in words for words in notes)
