"""A reader, or a foreign publisher, of another vendor's middleware: Cyclone DDS without ROS 2, in a process of its own.

Prints one JSON document: of every topic what came, in the order in which it came.
"""

import argparse
import json
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "cyclone_dds"))

from cyclone_messages import ActiveGraph, AgentState, Header, Node, Progress, Time, state_topic
from cyclonedds.qos import Policy

QUIET, LONGEST_QUIET = 1.0, 10.0  # s after the end of the run without a message: with all last states, and without


def entry(topic: str, message: Any) -> Any:
    """What is noted of a message."""
    if topic.endswith("/state"):
        return [message.step, message.mode, zlib.crc32(np.array(message.state).tobytes())]
    if topic == "graph":
        return [message.sequence, message.first_step, message.last_step]
    if topic == "experiment":
        return message.data
    return [message.agent, message.step]


def forge(node: Node, run: list[int], agents: int) -> None:
    """Messages that would change the run if they were believed."""
    header, another = Header(Time(0, 0), ""), [7] * len(run)
    for agent in range(1, agents + 1):
        node.writers[state_topic(agent)].write(AgentState(header, another, agent, 1, 1, [], [99.0, 99.0]))
        node.writers[state_topic(agent)].write(AgentState(header, run, agent, 10**9, 1, [], [99.0, 99.0]))
    node.writers["graph"].write(ActiveGraph(header, another, 0, 2, "ring", 0, 10**6, [1], [2], [9.0]))
    node.writers["end"].write(Progress(header, run, 0, 10**6))
    node.writers["progress"].write(Progress(header, run, 1, 10**6))


def missing(came: dict[str, list[Any]], states: list[str]) -> bool:
    """Whether the last state of an agent has not come; on a busy machine it may come a while after the end."""
    last = came["end"][-1][1] if came["end"] else 0
    return any(not came[topic] or max(each[0] for each in came[topic][-20:]) < last for topic in states)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--agents", type=int, default=5)
    parser.add_argument("--name", default="cyclone_reader")
    parser.add_argument("--pause", type=float, default=0.0, help="s per message, of which no more than 100 may wait")
    parser.add_argument("--until", type=Path, help="file until whose existence only 20 states of every agent are taken")
    parser.add_argument("--latched", action="store_true", help="read only what late readers get")
    parser.add_argument("--forge", action="store_true", help="write, too, as soon as the first state has come")
    parser.add_argument("--seen", type=Path, help="file that is made when 20 states of every agent have come")
    options = parser.parse_args()
    node = Node(options.name, options.domain)
    states = [] if options.latched else [state_topic(i + 1) for i in range(options.agents)]
    limits = [Policy.ResourceLimits(max_samples=100)] if options.pause or options.until else []
    others = Policy.IgnoreLocal.Participant  # it would take the end that it forges for that of the run, and leave
    readers = {topic: node.read(topic, others) for topic in ("experiment", "graph", "progress", "end")}
    readers |= {topic: node.read(topic, others, *limits) for topic in states}
    for topic in ("graph", "progress", "end", *states) if options.forge else ():
        node.write(topic)
    # What it forges must reach another node, not only itself: readers that it does not know yet would miss it.
    while node.without_writer() or any(not node.readers_of(topic) - {node.name} for topic in node.writers):
        time.sleep(0.01)
    node.announce()
    came: dict[str, list[Any]] = {topic: [] for topic in readers}
    last = time.monotonic()
    while not came["end"] or time.monotonic() < last + (LONGEST_QUIET if missing(came, states) else QUIET):
        held = options.until and not options.until.exists()
        for topic, reader in readers.items():
            if held and topic in states and len(came[topic]) >= 20:
                continue
            for message in reader.take(N=1 if limits else 1000):
                if hasattr(message, "header") or hasattr(message, "data"):  # not the news that its writer has gone
                    came[topic].append(entry(topic, message))
                    last = time.monotonic()
                    time.sleep(options.pause)
                    if options.forge and topic in states:
                        options.forge = False
                        forge(node, list(message.run), options.agents)
        if options.seen and all(len(came[topic]) >= 20 for topic in states) and came["experiment"]:
            options.seen.touch()
        time.sleep(0.001)
    print(json.dumps(came))


if __name__ == "__main__":
    main()
