"""An agent in a program of its user, beside the others of a run; the example of the documentation."""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import run_file
from pages import ROOT, blocks

from experiments import compare
from msg_analysis.bags.reading import read_bag
from msg_analysis.inference.comparison import Comparison
from msg_analysis.twin.check import check

OTHERS = [word for number in "1234" for word in ("--agent", number)]
EXAMPLE = Path(__file__).parents[2] / "docs/external_agent/my_agent.py"
POSE_ROBOT = Path(__file__).parents[1] / "support/pose_robot.py"


def verdict(network: Any, record: Path, *gain: str) -> Comparison:
    """Of a run whose agent 5 is the example."""
    bag, options = network.directory / "runs/mine", ("--await", "recorder")
    nodes = [
        network.start("switcher", record, *options),
        network.start("agent", record, *OTHERS, *options),
        network.start("recorder", record, "--out", bag),
        network.program(sys.executable, "-P", EXAMPLE, record, "5", *gain),
    ]
    for node in nodes:
        network.ended(node)
    run = read_bag(bag)
    assert run.completeness.complete
    return compare(run, max_missed=1.0)  # a busy machine is late


def test_its_step_is_judged(network: Any, domain: int) -> None:
    """It obeys the law with noise of its own, of a fixed seed; with 0.7 of the gain it is named."""
    record = run_file(network.directory, 5, run={"duration": 200})
    assert verdict(network, record).verdict == "agrees"


def test_a_wrong_gain_is_found(network: Any, domain: int) -> None:
    record = run_file(network.directory, 5, run={"duration": 200, "replicas": 8}, noise={"loss": 0.2, "link": 0.1})
    found = verdict(network, record, "0.7")
    assert (found.verdict, found.causes[0].kind, found.causes[0].agent) == ("disagrees", "gain", 5)


REALTIME = {"duration": 6, "pace": "realtime", "speed": 1, "replicas": 1, "start": "zero", "seed": 0}
LOCALHOST = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
MAP = 'agents: {"*": {topic: "/robot_{i}/x", field: data}}'
ROBOT, DDS_ROBOT = EXAMPLE.with_name("robot.py"), EXAMPLE.with_name("dds_robot.py")


@contextmanager
def robots(network: Any, *programs: Sequence[str | Path]) -> Iterator[list[Any]]:
    """Programs that run beside a network; rclpy may raise when a signal comes in the middle of a call."""
    started = [network.program(sys.executable, "-P", *program, **LOCALHOST) for program in programs]
    try:
        yield started
    finally:
        for robot in started:
            robot.terminate()
            robot.communicate(timeout=60)


def external(network: Any, domain: int, agents: str, *options: str | Path, mapped: str = "", **run: Any) -> Any:
    """Start ``msg-agents run`` without a verdict."""
    if mapped:
        (network.directory / "robots.yaml").write_text(mapped)
        options = ("--map", network.directory / "robots.yaml", *options)
    file = network.file(run=REALTIME | run)
    return network.record(file, "--domain", str(domain), "--external", agents, *options, "--json")


def judged(network: Any) -> Comparison:
    """Of the run. Level 0.001: the times of robots are not ours to fix, and a busy machine is late."""
    return compare(read_bag(network.bag()), level=0.001, max_missed=1.0)


def test_in_real_time(network: Any, domain: int) -> None:
    """A program of a user in a run that waits for it, and says how to start it; the check leaves it out."""
    run = external(network, domain, "5", duration=20, speed=5)
    network.wait_for(network.nodes, 60, "processes")
    mine = network.program(sys.executable, "-P", EXAMPLE, network.run_file(), "5", **LOCALHOST)
    stdout, stderr = network.ended(run)
    network.ended(mine)
    assert "agent 5 is external: start a program with msg_agents.ExternalAgent for each, with the run record" in stderr
    assert json.loads(stdout)["failures"] == []
    found = read_bag(network.bag())
    assert found.record.experiment.run.external == [5]
    comparison = compare(found, max_missed=1.0)
    assert (comparison.verdict, comparison.to_json()["external"]) == ("agrees", [5])
    outcome = check(found)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, 4 * 401)


def test_robots(network: Any, domain: int) -> None:
    """Programs of plain rclpy, and of plain DDS, take part in a run by what they publish."""
    pytest.importorskip("cyclonedds")
    with robots(network, [ROBOT, "3", "2", "4"], [DDS_ROBOT, "5", "1", "4"]):
        run = external(network, domain, "3,5", mapped=MAP)
        stdout, stderr = network.ended(run)
    assert "agents 3, 5 are external: waiting for /robot_3/x, /robot_5/x" in stderr
    assert json.loads(stdout)["failures"] == []
    found = read_bag(network.bag())
    assert found.completeness.complete
    moved = (np.diff(found.states[:, [2, 4], 0], axis=0) != 0.0).mean(axis=0)
    assert (moved > 0.5).all(), moved
    comparison = judged(network)
    # On a busy machine the programs may stand still for a while, and nothing else.
    assert comparison.verdict == "agrees" or {cause.kind for cause in comparison.causes} == {"frozen"}, (
        comparison.causes
    )


def test_a_wrong_robot(network: Any, domain: int) -> None:
    """With twenty times the gain it is named. It publishes poses, is told poses, and reads those of all agents."""
    mapped = "agents: {5: {topic: /robot_5/pose, field: pose.position.x, hears: pose}}"
    heard = network.directory / "poses.json"
    changes = {"publish": ["pose"], "frame": "odom", "duration": 10}
    with robots(network, [POSE_ROBOT, heard, "20", "5", "1", "4"]):
        assert network.result(external(network, domain, "5", mapped=mapped, **changes))["failures"] == []
    comparison = judged(network)
    assert (comparison.verdict, comparison.causes[0].agent) == ("disagrees", 5)
    poses, states = json.loads(heard.read_text()), read_bag(network.bag()).states[:, 0, 0].tolist()
    assert {frame for frame, _ in poses} == {"odom"}
    assert len(poses) > len(states) // 2
    assert {x for _, x in poses} <= set(states)


def test_a_robot_that_ends(network: Any, domain: int) -> None:
    """Before the run does: its state stays; the run says so, and the verdict names it."""
    with robots(network, [ROBOT, "5", "1", "4"]) as (robot,):
        run = external(network, domain, "5", mapped=MAP, duration=10)
        network.wait_for_steps(40)
        robot.terminate()  # killed, it would leave shared memory behind
        _, stderr = network.ended(run)
    assert "agent 5 is external: nothing on /robot_5/x for " in stderr
    comparison = judged(network)
    assert (comparison.verdict, comparison.causes[0].kind, comparison.causes[0].agent) == ("disagrees", "frozen", 5)


@pytest.mark.parametrize(
    ("mapped", "words"),
    [
        (MAP, r"agents? (3|5|3, 5) (is|are) external, and did not come within 1 s: nobody publishes .*/robot_[35]/x"),
        ("", "agents 3, 5 are external, and did not come within 1 s: nobody has started them"),
    ],
)
def test_agents_that_do_not_come(network: Any, domain: int, mapped: str, words: str) -> None:
    run = external(network, domain, "3,5", "--external-timeout", "1", mapped=mapped)
    failures = network.result(run, 3)["failures"]
    assert re.fullmatch(words, failures[0])
    assert len([line for line in failures if "last recorded step" not in line]) == 1


def test_a_map_with_another_field(network: Any, domain: int) -> None:
    """It is noticed as soon as the topic is there, before the run."""
    with robots(network, [ROBOT, "5", "1", "4"]):
        run = external(network, domain, "5", mapped=MAP.replace("data", "pose.position.x"))
        failures = network.result(run, 3)["failures"]
    words = "/robot_5/x: messages are std_msgs/msg/Float64 and have no number pose.position.x: correct the map"
    assert failures[0] == f"agent_5 (external): exit code 2: error: {words}"


@pytest.mark.parametrize(
    ("changes", "field", "words"),
    [
        ({"pace": "lockstep", "replicas": 1}, "data", "run: pace lockstep, replicas 1: expected realtime and 1"),
        ({"pace": "realtime", "replicas": 2}, "data", "run: pace realtime, replicas 2: expected realtime and 1"),
        ({"pace": "realtime", "replicas": 1}, "a b", "'a b': expected a field such as pose.position.x or data[0]"),
    ],
)
def test_robots_that_cannot_take_part(
    network: Any, domain: int, changes: dict[str, Any], field: str, words: str
) -> None:
    record, mapped = run_file(network.directory, 5, run=changes), network.directory / "robots.yaml"
    mapped.write_text(json.dumps({"agents": {"*": {"topic": "/robot_{i}/x", "field": field}}}))
    assert words in network.ended(network.start("external", record, "--agent", "5", "--map", mapped), 2)[1]


def test_a_robot_that_does_not_come(network: Any, domain: int) -> None:
    record = run_file(network.directory, 5, run={"pace": "realtime", "replicas": 1})
    mapped = network.directory / "robots.yaml"
    mapped.write_text('agents: {"*": {topic: "/robot_{i}/x", field: data}}')
    options = ("--agent", "5", "--map", mapped, "--discovery-timeout", "1")
    assert "/robot_5/x" in network.ended(network.start("external", record, *options), 2)[1]


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ("return 1 / 0", "Mine of agent 5, step 0: ZeroDivisionError: division by zero"),
        ("return float('nan')", "Mine of agent 5, step 0: [nan, nan]: expected finite numbers"),
        ("return [1.0, 2.0, 3.0]", "Mine of agent 5, step 0: ValueError: "),
    ],
)
def test_a_step_that_fails(network: Any, domain: int, step: str, words: str) -> None:
    """The error names agent and step; the others say that it has left."""
    record = run_file(network.directory, 5, run={"duration": 20})
    program = network.directory / "mine.py"
    program.write_text(
        "import sys\nfrom msg_agents import ExternalAgent\nfrom msg_analysis import InputError\n"
        f"class Mine(ExternalAgent):\n    def step(self, k, graph, own, heard):\n        {step}\n"
        "try:\n    Mine(sys.argv[1], 5, readers=()).run()\n"
        "except InputError as error:\n    sys.exit(f'error: {error}')\n"
    )
    options = ("--timeout", "1")
    others = [
        network.start("switcher", record, *options),
        network.start("agent", record, *OTHERS, *options),
    ]
    mine = network.program(sys.executable, "-P", program, record)
    _, stderr = mine.communicate(timeout=100)
    assert (mine.returncode, words in stderr) == (1, True), stderr
    for node in others:
        assert re.search("left the network|did not discover", network.ended(node, 2)[1])


def test_the_page_shows_the_example() -> None:
    (shown,) = [block for block in blocks(ROOT / "docs/wire.md", "python") if "ExternalAgent" in block]
    assert shown.strip() in EXAMPLE.read_text().replace("  # noqa: ARG002", "")
