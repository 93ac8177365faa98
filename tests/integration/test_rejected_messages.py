"""Other publishers on the topics of a run: their messages are refused, counted, and have no effect on the result."""

import dataclasses
import html
import json
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_node import STEPS, Forgery, Refused, batch, graph, run_beside, states
from networks import assert_equal_to_twin
from started_processes import started_processes

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_analysis.inference.pool import compare
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import ActiveGraph, AgentState, Progress, encode_string
from msg_analysis.model.graph_path import holding_periods
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import first_graph
from msg_analysis.twin.simulate import new_record


def test_another_run_and_nonsense(network: Any) -> None:
    """Another run of the same experiment, complete and well-formed: its states, graph, progress, record and end."""
    # Bytes that are no message, and messages of this run that cannot be.
    record = new_record(network.experiment(run={"processes": 2}))
    other = new_record(network.experiment(run={"processes": 2, "seed": 8}))
    forged = of_another_run(record.run.bytes, other) + nonsense(record.run.bytes)
    trajectory, logs, refused = run_beside(network, record, forged)
    assert trajectory.completeness.complete
    assert trajectory.completeness.received == trajectory.completeness.expected
    assert trajectory.completeness.duplicates == 0
    assert trajectory.completeness.refused == {}
    assert trajectory.record.run == record.run
    assert_equal_to_twin(trajectory)
    for name, log in logs.items():  # one warning for each reason and topic
        warnings = [line.partition("refused a message on ")[2] for line in log.splitlines() if "refused a" in line]
        assert len(warnings) == len(set(warnings)) > 0, name
    assert {reason for _, _, reason in refused} == {
        *("other run", "wrong length", "undecodable", "of another agent than its topic", "unknown agent"),
        "contradicts the run record",
    }

    for agent in (1, 2, 3, 5):  # who are heard in the other process
        topic = f"agent_{agent}/state"
        (by_agent,) = (n for (_, *what), n in refused.items() if what == [topic, "other run"])
        assert by_agent == STEPS + 1
    assert refused["recorder", "states", "other run"] == 1 + STEPS + 1  # a batch, and every state of the other one
    assert refused["switcher", "progress", "other run"] == 6
    for node in ("agent_1", "agent_3", "recorder"):
        assert refused[node, "end", "other run"] == 1
        assert refused[node, "graph", "other run"] == 1
        assert refused[node, "graph", "contradicts the run record"] == 3

    assert refused["recorder", "states", "wrong length"] == STEPS + 1
    assert refused["recorder", "states", "undecodable"] == (len(GARBAGE) - 1) + len(GARBAGE) + 1
    assert refused["agent_3", "agent_2/state", "wrong length"] == STEPS + 1
    assert refused["agent_5", "agent_1/state", "of another agent than its topic"] == 10
    assert refused["agent_5", "agent_1/state", "undecodable"] == len(GARBAGE) - 1
    assert refused["switcher", "progress", "unknown agent"] == 2
    assert refused["recorder", "experiment", "undecodable"] == 4 + len(GARBAGE) - 1
    assert refused["recorder", "experiment", "other run"] == 2  # that of the other run, and one that only has an id


GARBAGE = [b"", b"\x00", b"\x00\x01\x00\x00", bytes(range(40)), b"\xff" * 200, b"\x00\x01\x00\x00" + b"\xff" * 96]


def of_another_run(run: bytes, record: RunRecord) -> list[Forgery]:
    """All that another run has, and a batch of it that says that it is of this one."""
    other = record.run.bytes
    forged = [("experiment", encode_string(record.to_json())), graph(other)]
    forged += [message for agent in range(1, 6) for message in states(other, agent)]
    forged += [batch(other, states(other, 4)), batch(run, states(other, 4))]
    forged += [("progress", Progress(0, other, agent, STEPS).encode()) for agent in range(6)]
    return [*forged, ("end", Progress(0, other, 0, STEPS).encode())]


def nonsense(run: bytes) -> list[Forgery]:
    """No messages, or impossible ones."""
    topics = ["agent_1/state", "agent_3/state", "states", "graph", "progress", "end", "experiment"]
    forged = [(topic, data) for topic in topics for data in GARBAGE if data]
    forged += states(run, 1, replicas=3) + states(run, 2, replicas=1)
    forged += [("agent_1/state", data) for _, data in states(run, 5)[:10]]  # on another agent's topic
    forged += [batch(run, states(run, 1, replicas=3)), batch(run, [("", data) for data in GARBAGE])]
    forged += [("states", data[:-9]) for _, data in [batch(run, states(run, 1))]]
    forged += [graph(run, sequence=7), graph(run, first_step=5), graph(run, first_step=9, last_step=3)]
    forged += [("progress", Progress(0, run, agent, STEPS).encode()) for agent in (6, 2**32 - 1)]
    return forged + [("experiment", encode_string(text)) for text in ("", "{}", "[1]", '{"run": 1}', "hello")]


def test_a_forged_state_is_noticed_and_nothing_is_concluded(network: Any) -> None:
    """Right run, right agent, a step that is to come, another value: whoever hears it first believes it."""
    # Who of the two is right nobody can know. But all notice, and the state counts as missing.
    record = new_record(network.experiment(run={"processes": 2}))
    trajectory, _, refused = run_beside(network, record, [states(record.run.bytes, 2)[5]])
    assert refused["agent_3", "agent_2/state", "contradicts an earlier copy"] == 1
    assert refused["recorder", "/agent_2/state", "contradicts an earlier copy"] == 1
    assert trajectory.completeness.refused == {"contradicts an earlier copy": 1}
    assert not trajectory.present[5, 1]
    assert trajectory.completeness.missing == 1
    assert compare(trajectory).verdict == "incomplete"


# Listens, and sends states that cannot be as seen from the step at which the run is; says at which step it has ended.
FOREIGN = """
import random, sys, time
from pathlib import Path
import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from msg_agents_interfaces.msg import AgentState as StateMsg, StateBatch
from msg_agents.nodes.ros import ros_profile
from msg_analysis.messages import topics
from msg_analysis.messages.messages import AgentState, StateFrame
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.model.run_record import RunRecord

record = RunRecord.from_json(Path(sys.argv[1]).read_text(), "run.json")
rng = random.Random(sys.argv[2])
run, last = record.run.bytes, record.experiment.steps
frame = StateFrame(run, 2, 0)
now = [0]
rclpy.init()
node = rclpy.create_node("foreign", enable_rosout=False)
state = node.create_publisher(StateMsg, "agent_2/state", ros_profile(topics.STREAM))
states = node.create_publisher(StateBatch, "states", ros_profile(topics.STREAM))

def listen(data):  # to the true agent, not to itself
    _, step, _, value = frame.unwrap(data) or (0, 0, 0, b"")
    if value and np.frombuffer(value)[0] != 9:
        now[0] = step

# Only the newest, and not reliable: whoever is as slow as this would hold back the whole network.
newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
node.create_subscription(StateMsg, "agent_2/state", listen, newest, raw=True)
for agent in (1, 3):  # the run awaits a reader of all states
    node.create_subscription(StateMsg, f"agent_{agent}/state", lambda _: None, newest, raw=True)
while state.get_subscription_count() < 2 or not states.get_subscription_count():  # a neighbour, this process; recorder
    time.sleep(0.1)
while now[0] < 8300:
    rclpy.spin_once(node, timeout_sec=0.1)
    time.sleep(0.01)
order = [old for old in (True, False) for _ in range(60)]
rng.shuffle(order)
for number, old in enumerate(order):
    rclpy.spin_once(node, timeout_sec=0)
    if number % 20 == 0:  # not each time: on a busy machine, every pause is a long one
        time.sleep(0.001)
    # The recorder may be 2,000 steps behind.
    step = rng.randrange(now[0] - 8000) if old else min(now[0] + 12_500, last)
    message = AgentState(0, run, 2, step, 1, np.full(2, 9.0)).encode()
    state.publish(message)
    states.publish(encode_batch(run, [message]))
print(now[0], flush=True)
time.sleep(600)
"""


def test_a_foreign_node_in_the_middle(network: Any, repetition: int, rng: random.Random) -> None:
    """Steps long past and far ahead, sent to a run that is under way; the foreign node is killed at last."""
    # 20,000 steps: in time, the last one is more than 6,000 ahead, and the recorder refuses it as impossible.
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    file = network.file(graphs=graphs, run={"duration": 1000, "processes": 2})
    with free_domain() as domain, started_processes() as started:
        options = ("--out", network.directory / "runs", "--domain", str(domain), "--await", "foreign", "--json")
        run = network.start("run", file, *options)
        network.wait_for(network.nodes, 30, "a node")
        command = [sys.executable, "-P", "-c", FOREIGN, str(network.run_file()), str(rng.random())]
        started.append(subprocess.Popen(command, env=node_environment(domain), stdout=subprocess.PIPE, text=True))
        assert int(started[0].stdout.readline()) < 13_500  # it was in time
        result = network.completed(run)
    refused = {(entry["topic"].lstrip("/"), entry["reason"]): entry["count"] for entry in result["rejected_messages"]}
    for reason in ("step too old", "a step that a peer cannot have reached"):
        assert refused["agent_2/state", reason] > 0, reason
    report = html.unescape(Path(result["report"]).read_text())
    assert all(f"<td>{entry['reason']}</td>" in report for entry in result["rejected_messages"])


PACES = {"lockstep": {}, "realtime": {"pace": "realtime", "speed": 5}}
MANY = 200  # messages of each kind, before the run and again while it goes on


def record_of(network: Any, pace: str) -> RunRecord:
    return new_record(network.experiment(run={"processes": 2, **PACES[pace]}))


def unharmed(record: RunRecord, trajectory: Any) -> None:
    """All is there, and as the twin says."""
    assert trajectory.completeness.complete
    assert trajectory.completeness.missing_modes == 0
    assert json.loads(trajectory.record.to_json()) == json.loads(record.to_json())
    assert_equal_to_twin(trajectory)


def steering(record: RunRecord) -> list[Forgery]:
    """A record with other noise, the other graph, the last step of everybody, the end and another epoch."""
    run = record.run.bytes
    noisy = record.experiment.parse(record.experiment.to_document() | {"noise": {"process": 3.0}})
    first = next(holding_periods(record.experiment, first_graph(record.experiment)))
    other = graph(run, mode=2 - first.mode, name=["ring", "line"][first.mode], last_step=first.last_step)
    forged: list[Forgery] = [
        ("experiment", encode_string(dataclasses.replace(record, experiment=noisy).to_json())),
        other,
        graph(run, last_step=10**9),
        *(("progress", Progress(STEPS * 50_000_000, run, agent, STEPS).encode()) for agent in range(6)),
        *(("resend", Progress(0, run, agent, 0).encode()) for agent in range(1, 6)),
        ("end", Progress(STEPS * 50_000_000, run, 0, STEPS).encode()),
    ]
    if record.experiment.run.pace == "realtime":
        forged.append(("epoch", Progress(10**18, run, 0, 0).encode()))
    return forged


def steered_nobody(refused: Refused, pace: str) -> None:
    """Every reader has refused all of ``steering``."""
    assert refused["recorder", "experiment", "contradicts the run record"] == 1
    for node in ("agent_1", "agent_3", "recorder"):
        assert refused[node, "graph", "contradicts the run record"] == 2
        assert refused[node, "end", "not signed with the key of the run"] == 1
    assert refused["switcher", "progress", "not signed with the key of the run"] == 6
    for host in ("agent_1", "agent_3"):
        assert refused[host, "resend", "not signed with the key of the run"] == 5
        assert refused[host, "epoch", "not signed with the key of the run"] == (pace == "realtime")


def test_steering_and_states_that_are_not_finite(network: Any) -> None:
    """The states are of the right run, the right agent and the right steps, and there before the truth."""
    record = record_of(network, "lockstep")
    values = [np.nan, np.inf, -np.inf, np.nan, np.inf]
    forged = [m for agent, value in enumerate(values, start=1) for m in states(record.run.bytes, agent, value=value)]
    forged.append(batch(record.run.bytes, [message for message in forged if message[0] == "agent_4/state"]))
    trajectory, _, refused = run_beside(network, record, [*steering(record), *forged])
    unharmed(record, trajectory)
    steered_nobody(refused, "lockstep")
    # In a batch; and as single messages, which the recorder reads when it sees another node on these topics.
    assert refused["recorder", "/agent_4/state", "not finite"] == 2 * (STEPS + 1)
    for node, agent in (("agent_5", 1), ("agent_3", 2), ("agent_2", 3), ("agent_1", 5)):
        assert refused[node, f"agent_{agent}/state", "not finite"] == STEPS + 1


def test_steering_and_other_messages_in_real_time(network: Any) -> None:
    """Before simulated time has begun: other epochs, states of other runs and layouts, what nobody can have yet."""
    # How many of the states are refused is not known: agents read only the newest of those that wait for them.
    record = record_of(network, "realtime")
    run, other = record.run.bytes, new_record(record.experiment).run.bytes
    forged = [message for agent in range(1, 6) for message in states(other, agent)]
    forged += states(run, 1, replicas=3) + states(run, 2, value=np.nan)
    forged += [("agent_3/state", AgentState(0, run, 3, STEPS + 1, 1, np.zeros(2)).encode())]
    forged += [("epoch", Progress(0, other, 0, 0).encode()), ("epoch", Progress(0, run, 2, 0).encode())]
    forged += [graph(other), ("end", Progress(0, other, 0, STEPS).encode())]
    trajectory, _, refused = run_beside(network, record, [*steering(record), *forged])
    unharmed(record, trajectory)
    steered_nobody(refused, "realtime")
    for host in ("agent_1", "agent_3"):
        assert refused[host, "epoch", "other run"] >= 1
        assert refused[host, "graph", "other run"] == 1


class Absurd:
    """Well-formed messages of a run with fields that no message of it has."""

    def __init__(self, record: RunRecord, chance: random.Random) -> None:
        self._run, self._chance, self._last = record.run.bytes, chance, record.experiment.steps
        self._steps = [0, 1, self._last - 1, self._last, self._last + 1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1]
        self._small = [0, 1, 2, 3, 6, 255, 2**31, 2**32 - 1]
        self.kinds: dict[str, Callable[[], bytes]] = {
            "experiment": self._experiment,
            "graph": self._graph,
            **dict.fromkeys(("progress", "resend", "end"), self._progress),
            **{f"agent_{agent}/state": self._state for agent in range(1, 6)},
            "states": self._states,
        }
        if record.experiment.run.pace == "realtime":
            self.kinds["epoch"] = self._progress
        self._document = json.loads(record.to_json())

    def messages(self, count: int) -> list[Forgery]:
        """So many of each kind, in any order."""
        found = [(topic, make()) for topic, make in self.kinds.items() for _ in range(count)]
        self._chance.shuffle(found)
        return found

    def _step(self) -> int:
        return self._chance.choice([*self._steps, self._chance.randrange(self._last)])

    def _stamp(self) -> int:
        return self._chance.choice([0, 50_000_000, -(10**9), 10**18, self._chance.randrange(10**10)])

    def _text(self) -> str:
        return self._chance.choice(["", "line", "ring", "\x1b[2J", "x" * 300, "\N{SNOWMAN}"])

    def _experiment(self) -> bytes:
        document = dict(self._document)
        key = self._chance.choice([key for key in document if key != "run"])
        document[key] = self._chance.choice([None, [], {}, "x", -1, 1e300, [[1.0]], {"format": 1}])
        return encode_string(json.dumps(document))

    def _graph(self) -> bytes:
        arcs = [(self._chance.choice(self._small), 2, self._chance.choice([0.0, -1.0, np.inf, np.nan, 1.0]))]
        first, last = self._step(), self._step()
        sequence, mode = self._chance.choice(self._small), self._chance.choice(self._small)
        message = ActiveGraph(0, self._run, sequence, mode, self._text(), first, last, arcs * self._chance.randrange(9))
        return dataclasses.replace(message, stamp=self._stamp(), frame_id=self._text()).encode()

    def _progress(self) -> bytes:
        agent = self._chance.choice([*self._small, 4, 5])
        return Progress(self._stamp(), self._run, agent, self._step(), self._text()).encode()

    def _state(self) -> bytes:
        """With at least one field that is impossible for any agent."""
        fields: dict[str, Any] = {"agent": 2, "step": self._step(), "mode": 1, "state": np.full(2, 7.0)}
        fields |= self._chance.choice(
            [
                {"agent": self._chance.choice([0, 6, 2**31, 2**32 - 1])},
                {"step": self._chance.choice([step for step in self._steps if step > self._last])},
                {"mode": self._chance.choice([3, 255, 2**32 - 1])},
                {"state": np.full(self._chance.choice([0, 1, 3, 40]), 7.0)},
                {"state": np.array([7.0, self._chance.choice([np.nan, np.inf, -np.inf])])},
                {"frame_id": self._text() or "map"},
                {"heard": np.array([2**64 - 1] * self._chance.randrange(5, 99), np.uint64)},
            ]
        )
        return AgentState(self._stamp(), self._run, **fields).encode()

    def _states(self) -> bytes:
        """A batch of such states, or one that is cut off by more than the middleware fills up with zeros."""
        data = encode_batch(self._run, [self._state() for _ in range(self._chance.randrange(1, 5))])
        return self._chance.choice([data, data, data[: self._chance.randrange(1, len(data) - 8)]])


def test_batches_that_processes_read(network: Any) -> None:
    """In a dense network, where agents hear each other by them."""
    run_of_three = {"dt": 0.01, "duration": 1, "processes": 3, "start": "zero"}
    dense = {"agents": 24, "graphs": {"all": {"complete": True}}, "switching": {"generator": [[0]]}}
    record = new_record(network.experiment(**dense, run=run_of_three))
    run, other = record.run.bytes, bytes(16)
    good = {"agent": 12, "step": 3, "mode": 1, "state": np.zeros(2)}
    bad: list[dict[str, Any]] = [{"agent": 25}, {"step": 2**40}, {"mode": 2}, {"state": np.array([0, np.nan])}]
    forged = [encode_batch(run, [AgentState(0, run, **(good | fields)).encode()]) for fields in bad]
    forged += [encode_batch(other, [AgentState(0, other, **good).encode()]), b"\0\1\0\0"]
    trajectory, _, refused = run_beside(network, record, [("states", data) for data in forged], of_batches=4)
    unharmed(record, trajectory)
    for node in ("agent_1", "agent_9", "agent_17", "recorder"):
        assert refused[node, "states", "unknown agent"] == 1
        assert refused[node, "states", "other run"] == 1
        assert refused[node, "states", "undecodable"] == 1
    for node in ("agent_1", "agent_8", "agent_17", "agent_24"):  # whoever hears agent 12
        assert refused[node, "agent_12/state", "a step that a peer cannot have reached"] == 1
        assert refused[node, "agent_12/state", "unknown mode"] == 1
        assert refused[node, "agent_12/state", "not finite"] == 1


@pytest.mark.parametrize("pace", PACES)
def test_absurd_fields(network: Any, pace: str, rng: random.Random) -> None:
    """400 of each kind, half of them while the run goes on."""
    length = {"duration": 120} if pace == "lockstep" else {"duration": 20, "speed": 10}
    record = new_record(network.experiment(run={"processes": 2} | PACES[pace] | length))
    absurd = Absurd(record, rng)
    early, meanwhile = absurd.messages(MANY), absurd.messages(MANY)
    trajectory, _, refused = run_beside(network, record, early, meanwhile, endless=pace == "realtime")
    unharmed(record, trajectory)
    counts: Counter[tuple[str, str]] = Counter()
    for (node, topic, reason), count in refused.items():
        assert reason != "contradicts an earlier copy", (node, topic)
        counts[node, topic] += count
    hosts = [(host, topic) for host in ("agent_1", "agent_3") for topic in ("resend", "end")]
    hosts += [("agent_1", "epoch"), ("agent_3", "epoch")] if pace == "realtime" else []
    for reader in [
        *hosts,
        ("switcher", "progress"),
        ("recorder", "experiment"),
        ("recorder", "states"),
        ("recorder", "end"),
    ]:
        assert counts[reader] > 1.1 * MANY, reader
    for agent in (1, 2, 3, 5):
        (heard,) = (n for (node, topic), n in counts.items() if topic == f"agent_{agent}/state")
        assert heard > (1.1 * MANY if pace == "lockstep" else 0)  # in real time, only the newest of what waits is read
