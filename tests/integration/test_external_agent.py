"""An agent in a program of its user, beside the others of a run; the example of the documentation."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import run_file
from pages import ROOT, blocks

from experiments import compare
from msg_analysis.bags.reading import read_bag
from msg_analysis.inference.comparison import Comparison

OTHERS = [word for number in "1234" for word in ("--agent", number)]
EXAMPLE = Path(__file__).parents[2] / "docs/external_agent/my_agent.py"


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
    record = run_file(network.directory, 5, run={"duration": 200}, noise={"loss": 0.2, "link": 0.1})
    found = verdict(network, record, "0.7")
    assert (found.verdict, found.causes[0].kind, found.causes[0].agent) == ("disagrees", "gain", 5)


def test_in_real_time(network: Any, domain: int) -> None:
    record = run_file(network.directory, 5, run={"duration": 20, "pace": "realtime", "speed": 5})
    assert verdict(network, record).verdict == "agrees"


@pytest.mark.parametrize("gain", ["1.0", "20.0"])
def test_a_robot_with_a_topic(network: Any, domain: int, gain: str) -> None:
    """A program of plain rclpy: with twenty times the gain it is named. Level 0.001: its times are not ours to fix."""
    run = {"duration": 10, "pace": "realtime", "speed": 1, "replicas": 1, "start": "zero", "seed": 0}
    record = run_file(network.directory, 5, run=run)
    mapped, bag = network.directory / "robots.yaml", network.directory / "runs/mine"
    mapped.write_text('agents: {"*": {topic: "/robot_{i}/x", field: data}}')
    options = ("--await", "recorder")
    robot = network.program(sys.executable, "-P", EXAMPLE.with_name("robot.py"), "5", "1", "4", gain)
    nodes = [
        network.start("switcher", record, *options),
        network.start("agent", record, *OTHERS, *options),
        network.start("recorder", record, "--out", bag),
        network.start("external", record, "--agent", "5", "--map", mapped, *options),
    ]
    for node in nodes:
        network.ended(node)
    robot.terminate()
    robot.communicate(timeout=60)  # rclpy may raise when a signal comes in the middle of a call
    found = read_bag(bag)
    assert found.completeness.complete
    assert (np.diff(found.states[10:, 4, 0]) != 0.0).mean() > 0.9
    comparison = compare(found, level=0.001, max_missed=1.0)
    if gain == "1.0":  # on a busy machine the program may stand still for a while, and nothing else
        assert comparison.verdict == "agrees" or comparison.causes[0].kind == "frozen", comparison.causes
    else:
        assert (comparison.verdict, comparison.causes[0].agent) == ("disagrees", 5)


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
