"""Agents of the user in a run: who starts them, how long they are waited for, and what is said of them."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import experiment

from msg_agents.channel.channel_file import Channel
from msg_agents.process_layout import HostAssignment, Hosts, lay_out_network, partners
from msg_agents.run.external import ExternalAgents, robot_topics
from msg_agents.run.runner import run_network
from msg_analysis.errors import InputError
from msg_analysis.model.run_record import Until

TOPICS = {2: "/robot_3/x", 4: "/robot_5/x"}


class Watched:
    """External agents 3 and 5 of five, which have 10 s, under a clock that the test sets."""

    def __init__(self, topics: Mapping[int, str] = TOPICS, **run: Any) -> None:
        self.now = 0.0
        what = experiment(5, run={"pace": "realtime", "external": [3, 5]} | run)
        self.agents = ExternalAgents(what, topics, 10.0, clock=lambda: self.now)

    def at(self, now: float, *steps: int) -> str | None:
        self.now = now
        return self.agents.failure(steps, 100)


def test_one_that_does_not_come() -> None:
    watched = Watched()
    assert [watched.at(9, *steps) for steps in ((), (-1, 0, -1, 0, 0), (0, 0, -1, 0, 0))] == [None] * 3
    assert watched.at(20, -1, 0, -1, 0, 0) is None  # one of ours has not come either: its process says so
    words = "agent 3 is external, and did not come within 10 s: nobody publishes /robot_3/x"
    assert watched.at(20, 0, 0, -1, 0, 0) == words


def test_those_that_the_others_did_not_discover() -> None:
    watched = Watched({})
    lines = [
        "error: after 10 s switcher did not discover: agent_3, agent_5. Are they running in ROS_DOMAIN_ID 7?",
        "error: after 25 s agent_2 did not discover: agent_1, agent_3. Are they running in ROS_DOMAIN_ID 7?",
    ]
    words = "agents 3, 5 are external, and did not come within 10 s: nobody has started them"
    assert watched.agents.not_discovered(lines) == words
    assert watched.agents.not_discovered(["error: after 30 s agent_1 did not discover: agent_2, agent_33."]) is None
    assert watched.agents.not_discovered(["error: agent_3 has another run record than the switcher"]) is None


@pytest.mark.parametrize("pace", ["realtime", "lockstep"])
def test_one_that_goes(pace: str) -> None:
    watched = Watched({}, pace=pace)
    ahead = 21 if pace == "lockstep" else 80
    assert watched.at(1, 20, 20, 20, 20, 20) is None
    assert watched.at(10, ahead, ahead, 20, ahead, ahead) is None
    words = "agent 3 is external, and made no step for 10 s after step 20: is it running?"
    assert watched.at(12, ahead, ahead, 20, ahead, ahead) == words
    assert watched.at(12, ahead, ahead, 21, ahead, ahead) is None


def test_one_that_is_not_waited_for() -> None:
    """The clock stands still; or, in lockstep, one of ours is the slowest; or it has made all steps."""
    watched = Watched()
    for now in (1, 50):
        assert watched.at(now, 20, 20, 19, 21, 20) is None
    watched = Watched({}, pace="lockstep")
    for now in (1, 50):
        assert watched.at(now, 19, 20, 20, 20, 20) is None
        assert not watched.agents.holds_up((19, 20, 20, 20, 20), 100)
    assert watched.agents.holds_up((20, 20, 20, 20, 20), 100)
    for now in (51, 100):
        assert watched.at(now, 100, 100, 100, 100, 100) is None


def test_robots_that_publish_nothing() -> None:
    watched = Watched()
    lines = ("at step 2, late by 60.0 ms", "nothing on /robot_3/x for 4.0 s", "nothing on /robot_3/x for 6.0 s")
    statuses = iter([{"agent_3": words, "agent_1": "nothing on /x"} for words in lines])
    seen = []
    for now in (2, 4, 6):
        watched.now = now
        seen.append(watched.agents.notes(lambda: next(statuses)))
    assert seen == [[], ["agent 3 is external: nothing on /robot_3/x for 4.0 s"], []]


def test_how_they_are_started() -> None:
    file = Path("/tmp/run.json")
    words = Watched().agents.how_to_start(file, 7)
    assert words == ("agents 3, 5 are external: waiting for /robot_3/x, /robot_5/x in ROS_DOMAIN_ID 7, within 10 s")
    words = Watched({}).agents.how_to_start(file, 7)
    assert "with the run record /tmp/run.json, in ROS_DOMAIN_ID 7, within 10 s" in words
    assert ExternalAgents(experiment(5), {}).how_to_start(file, 7) == ""


def test_the_map_of_a_run(tmp_path: Path) -> None:
    """It may have the external agents only; names are those of the experiment."""
    file = tmp_path / "robots.yaml"
    file.write_text("agents: {3: {topic: /robot_3/x, field: data}, e: {topic: /robot_5/x, field: data}}")
    run = {"pace": "realtime", "replicas": 1, "external": [3, "e"]}
    assert robot_topics(experiment(5, names=list("abcde"), run=run), file) == TOPICS
    with pytest.raises(InputError, match=r"robots.yaml: agents: 5: not in the map"):
        robot_topics(experiment(5, run=run | {"external": [3, 5]}), file)
    with pytest.raises(InputError, match=r"--map: .*robots.yaml: expected external agents"):
        robot_topics(experiment(5), file)
    file.write_text("agents: {3: {topic: /robot_3/x, fields: [a.x, a.y]}}")
    with pytest.raises(InputError, match=r"agents.3: expected `topic` and `field`"):
        robot_topics(experiment(5, run=run | {"external": [3]}), file)


@pytest.mark.parametrize("robots", [None, Path("/robots.yaml")])
def test_their_processes(robots: Path | None) -> None:
    """With a map they have processes, which are not started again; the switcher is the first to give up."""
    what = experiment(5, run={"pace": "realtime", "replicas": 1, "external": [3, 5]})
    options: dict[str, Any] = {"checkpoints": Path("/kept"), "robots": robots, "external_timeout": 60.0}
    processes = lay_out_network(what, Path("/run.json"), Path("/bag"), **options)
    agents = {process.name: process for process in processes if process.agents}
    assert {name: process.resumes for name, process in agents.items()} == {
        "agent_1": True,
        "agent_2": True,
        "agent_4": True,
        **({"agent_3": False, "agent_5": False} if robots else {}),
    }
    assert [name for name, process in agents.items() if process.external] == ["agent_3", "agent_5"] * bool(robots)
    if robots:
        wanted = ("external", "/run.json", "--agent", "3", "--map", "/robots.yaml", "--discovery-timeout", "75")
        assert agents["agent_3"].arguments[:8] == wanted
    timeouts = {}
    for process in processes:
        *_, (_, timeouts[process.name]) = [p for p in pairwise(process.arguments) if p[0] == "--discovery-timeout"]
    assert timeouts == dict.fromkeys(timeouts, "75") | {"switcher": "60"}
    found = partners(processes, np.ones((5, 5), dtype=bool))["agent_1"]
    assert found == {"agent_2", "agent_4", "recorder", "switcher"} | ({"agent_3", "agent_5"} if robots else set())


def test_what_they_cannot_take_part_in(tmp_path: Path) -> None:
    """Nothing is started."""
    what = experiment(5, run={"external": [3]})
    with pytest.raises(InputError, match=r"--until 1%: not with external agents without --map"):
        run_network(what, tmp_path / "runs", until=Until.parse("1%"))
    with pytest.raises(InputError, match=r"--channel: not with external agents: other programs do not reach its hosts"):
        run_network(what, tmp_path / "runs", channel=Channel.parse({}, what))
    assert not (tmp_path / "runs").exists()


def test_on_several_hosts() -> None:
    """They are on none, and their user starts them."""
    what = experiment(5, run={"external": [3, 5]})
    hosts = {"one": {"address": "192.0.2.1", "agents": [1]}, "two": {"address": "192.0.2.2", "agents": [2, 4]}}
    found = Hosts.parse({"recorder": "one", "hosts": hosts}, what)
    assert found.agents == {"one": (0,), "two": (1, 3)}
    processes = lay_out_network(what, Path("/run.json"), None, assignment=HostAssignment((1, 3), False, 60.0, 30.0))
    assert [process.agents for process in processes] == [(1,), (3,)]
    hosts["one"]["agents"] = [1, 3]
    with pytest.raises(InputError, match=r"agents: \[3\]: expected no external agents"):
        Hosts.parse({"recorder": "one", "hosts": hosts}, what)
