# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A first map of a bag, guessed from types and names of its topics; and what a log holds by a map."""

from __future__ import annotations

import json
import re
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.files import FileInventory, bag_files, stored_file, total_channels
from msg_analysis.bags.log_map import EVERY, NUMBER, LogMap, parse_map
from msg_analysis.bags.mapped_log import Contents, Series, is_table, read_contents, read_table, usable
from msg_analysis.bags.message_fields import Definitions, is_stamped, leaves
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.text import listed
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment.values import is_count

FIELDS = {  # of types that tell where something is, the likeliest first
    "nav_msgs/msg/Odometry": "pose.pose.position.x",
    "geometry_msgs/msg/PoseStamped": "pose.position.x",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose.position.x",
    "geometry_msgs/msg/PointStamped": "point.x",
    "geometry_msgs/msg/TransformStamped": "transform.translation.x",
    "geometry_msgs/msg/Pose": "position.x",
    "geometry_msgs/msg/Pose2D": "x",
    "geometry_msgs/msg/Point": "x",
    "turtlesim/msg/Pose": "x",
    "std_msgs/msg/Float64": "data",
    "std_msgs/msg/Float32": "data",
    "msg_agents_interfaces/msg/AgentState": "state[0]",
    "std_msgs/msg/Float64MultiArray": "data[0]",
    "std_msgs/msg/Float32MultiArray": "data[0]",
}
OWN_STATES, OWN_GRAPHS = "msg_agents_interfaces/msg/AgentState", "msg_agents_interfaces/msg/ActiveGraph"
TEXT = "std_msgs/msg/String"
OF_NETWORK = re.compile(r"graph|topolog|network|active|mode|formation", re.IGNORECASE)
GAP = 3.0  # median intervals
MOST_NAMES = 20  # different values of a topic that may name graphs


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    messages: int
    stamped: bool  # whether its messages have a header
    fields: tuple[str, ...]  # numbers in every message


def topics_of(bag: Path) -> list[Topic]:
    """All topics of a bag, by name; those whose definition cannot be read have no fields."""
    inventories = [FileInventory(stored_file(path)) for path in bag_files(bag)]
    found: dict[str, Any] = {}
    for inventory in inventories:
        deque(inventory.watch(), maxlen=0)
        for channel in inventory.file.channels.values():
            found.setdefault(channel.topic, inventory.file.schemas.get(channel.schema_id))
    counts = total_channels([inventory.count for inventory in inventories])
    topics, definitions = [], Definitions()
    for name, schema in sorted(found.items()):
        several: list[tuple[str, str]] = []
        stamped = False
        try:
            if schema:
                types = definitions.of(schema)
                several, stamped = leaves(types, schema.name), is_stamped(types, schema.name)
        except NotAvailableError:
            raise
        except InputError:
            pass
        fields = tuple(each for each, kind in several if kind.startswith("float"))
        if schema and "[" in (usual := FIELDS.get(schema.name, "")):
            fields += (usual,)
        topics.append(Topic(name, schema.name if schema else "", counts[name].messages, stamped, fields))
    return topics


def first_map(bag: Path) -> str:
    """A map in YAML, with comments; InputError: no topic of the bag has a number."""
    topics = topics_of(bag)
    agents = _agents(topics)
    if not agents:
        raise InputError(f"{bag}: no topic has a number in every message: expected states of agents")
    field = FIELDS.get(agents[0].type) or agents[0].fields[0]
    others = [name for name in agents[0].fields if name != field]
    field = f'"{field}"' if "[" in field else field
    pattern = _pattern([topic.name for topic in agents])
    lines = [
        f"# A first map of {bag.name}: correct it, then",
        f"#   msg-analysis map {bag} --map map.yaml --check",
        f"#   msg-analysis compare {bag} --law law.yaml --map map.yaml",
        "agents:",
    ]
    if pattern:
        lines.append(f'  "{EVERY}": {{topic: {_quoted(pattern)}, field: {field}}}  # {len(agents)} agents')
    else:
        lines += [f"  {i}: {{topic: {_quoted(topic.name)}, field: {field}}}" for i, topic in enumerate(agents, start=1)]
    if others:
        lines.append(f"# other numbers in {agents[0].type}: {listed(others, 8)}")
    stamped = all(topic.stamped for topic in agents)
    lines.append(f"time: {'header' if stamped else 'log'}  # header: stamps of the messages; log: when they arrived")
    own = agents[0].type == OWN_STATES
    if own:
        lines.append('# further replicas: fields: ["state[0]", "state[1]", ...]; or compare without --map')
    wanted = OWN_GRAPHS if own else TEXT
    graphs = [topic for topic in topics if topic.type == wanted and OF_NETWORK.search(topic.name)]
    if graphs:
        name = "name" if own else "data"
        lines.append(f"graph: {{topic: {_quoted(graphs[0].name)}, field: {name}}}  # names of the graphs of the law")
    else:
        lines.append("# graph: {topic: /network/active, field: data}   or {file: trace.csv}, or, if it never changed:")
        lines.append("# graph: {fixed: NAME}   or, if it is not known: hidden")
    lines += [
        "measurement_noise: 0" if own else "measurement_noise: estimate  # or a standard deviation, 0 if exact",
        "# units: {time: 1.0, state: 1.0}  # s per unit of time of the law; units of the log per unit of its states",
        "# period: 0.1  # s: use fewer samples",
        ("" if own else "# ") + "law: steps  # if the agents make the steps of a run, and not the continuous law",
    ]
    used = {topic.name for topic in (*agents, *graphs[:1])}
    rest = [f"#   {each.name}: {each.type}, {each.messages} messages" for each in topics if each.name not in used]
    lines += ["# topics that are not used:", *rest] if rest else []
    return "\n".join(" ".join(line.splitlines()) for line in lines) + "\n"  # no name in a bag makes a line of its own


def _quoted(text: str) -> str:
    """As YAML and JSON write it."""
    return json.dumps(text, ensure_ascii=True)


def _agents(topics: Sequence[Topic]) -> list[Topic]:
    """The largest group of topics of one type whose names differ by a number, else all of the likeliest type."""
    groups: dict[tuple[str, str], dict[int, Topic]] = {}
    usable = [topic for topic in topics if topic.fields and topic.messages]
    for topic in usable:
        for number in re.finditer(r"\d+", topic.name):
            key = topic.name[: number.start()] + NUMBER + topic.name[number.end() :], topic.type
            groups.setdefault(key, {})[int(number[0])] = topic
    order = list(FIELDS)

    def rank(key: tuple[str, str]) -> tuple[int, int]:
        likely = order.index(key[1]) if key[1] in order else len(order)
        return likely, -len(groups[key])

    several = [key for key, members in groups.items() if len(members) > 1]
    if several:
        best = groups[min(several, key=rank)]
        return [best[number] for number in sorted(best)]
    types = sorted(
        {topic.type for topic in usable}, key=lambda kind: order.index(kind) if kind in order else len(order)
    )
    return [topic for topic in usable if topic.type == types[0]] if types else []


def _pattern(names: Sequence[str]) -> str | None:
    """The topics with {i} in the place of their number, where these are 1, 2, ..."""
    for number in re.finditer(r"\d+", names[0]):
        pattern = names[0][: number.start()] + NUMBER + names[0][number.end() :]
        if [pattern.replace(NUMBER, str(i)) for i in range(1, len(names) + 1)] == list(names):
            return pattern
    return None


def check_log(path: Path, mapped: LogMap | None) -> dict[str, Any]:
    """What a log holds by a map, or by the first map: agents, rates, gaps, jumps of the clock, duplicates, NaN."""
    from msg_analysis.experiment.loading import parse_yaml

    if mapped is None:
        if is_table(path):
            raise InputError(f"{path}: is a table: expected --map with its columns")
        mapped = parse_map(parse_yaml(first_map(path), "first map"), "first map")
    contents = read_contents(path, mapped, mapped.sources(count_agents(path, mapped)))
    start = min(int(times.min()) for series in contents.agents for times in series.times)
    return {
        "source": str(path),
        "time": mapped.time,
        "start": start / SECOND,
        "agents": [_agent(i, series, start) for i, series in enumerate(contents.agents, start=1)],
        "graph": _graph(contents, start),
        "together": _together(contents.agents),
        "notes": contents.notes,
    }


def count_agents(path: Path, mapped: LogMap) -> int:
    """Number of agents: those that the map lists, or whose topics or columns are there."""
    listed_ = {int(key) for key in mapped.agents if is_count(key) or re.fullmatch(r"[0-9]{1,9}", str(key))}
    pattern = mapped.agents.get(EVERY)
    if pattern is None:
        if listed_ and max(listed_) > len(mapped.agents):
            raise InputError(f"agents: {max(listed_)}: expected all agents from 1: the map has {len(mapped.agents)}")
        return len(mapped.agents)
    text = next((each for each in (pattern.topic, *pattern.all_fields) if each and NUMBER in each), None)
    if text is None:
        raise InputError(f"agents.{EVERY}: by name: how many are there? expected {NUMBER}, or agents one by one")
    there = set(read_table(path)) if is_table(path) else {topic.name for topic in topics_of(path)}
    number = 1
    while number in listed_ or text.replace(NUMBER, str(number)) in there:
        number += 1
    if number == 1:
        raise InputError(f"{path}: no topic or column {text.replace(NUMBER, '1')}: expected those of the agents")
    return number - 1


def _agent(number: int, series: Series, start: int) -> dict[str, Any]:
    """Numbers about one agent, times in s since the start of the log."""
    times, values = series.joined()
    steps = np.diff(times) / SECOND
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if len(forward) else None
    gaps = forward[forward > GAP * usual] if usual else np.empty(0)
    regular = forward[forward <= GAP * usual] if usual else np.empty(0)
    finite = values[usable(values)]
    return {
        "agent": number,
        "source": series.what,
        "values": len(times),
        "short": series.short,
        "first": (int(times.min()) - start) / SECOND,
        "last": (int(times.max()) - start) / SECOND,
        "period": usual,
        "rate": 1.0 / usual if usual else None,
        "jitter": round(float(regular.std()), 9) if len(regular) else None,
        "gaps": len(gaps),
        "longest_gap": float(gaps.max()) if len(gaps) else None,
        "clock_jumps": int((steps < 0).sum()),
        "duplicates": int((steps == 0).sum()),
        "not_finite": len(values) - len(finite),
        "least": finite.min(axis=0).tolist() if len(finite) else None,
        "largest": finite.max(axis=0).tolist() if len(finite) else None,
        "change": _change(finite),
    }


def _change(values: FloatArray) -> float | None:
    """Root mean square of the change from value to value."""
    return float(np.sqrt((np.diff(values, axis=0) ** 2).mean())) if len(values) > 1 else None


def _graph(contents: Contents, start: int) -> dict[str, Any] | None:
    if contents.graph is None:
        return None
    times, values = contents.graph.joined()
    names = [str(value) for value in values[np.argsort(times, kind="stable")].tolist()]
    switches = sum(a != b for a, b in pairwise(names))
    return {
        "source": contents.graph.what,
        "messages": len(names),
        "switches": switches,
        "first": (int(times.min()) - start) / SECOND,
        "names": [name for name, _ in Counter(names).most_common(MOST_NAMES)],
    }


def _together(agents: Sequence[Series]) -> float:
    """Share of the sample times at which all agents have a value."""
    stamps: list[IntArray] = [np.unique(series.joined()[0]) for series in agents]
    every, counts = np.unique(np.concatenate(stamps), return_counts=True)
    return float((counts == len(agents)).sum() / len(every))
