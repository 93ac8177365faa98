"""Base of the nodes that watch a network, running or played: find the run, follow it, leave when it is over."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

import rclpy
from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.executors import Executor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_msgs.msg import String

from msg_agents.nodes.network_node import END_TOPIC, EXPERIMENT_TOPIC, OTHER_RUN, UNDECODABLE
from msg_agents.nodes.node_process import SPIN_SLICE, leave, make_executor
from msg_agents.nodes.ros.lean_node import QuietNode
from msg_agents.nodes.ros.node_parameters import ros_arguments
from msg_agents.nodes.ros.qos import LATCHED
from msg_agents.processes.environment import without_shared_memory
from msg_agents.terminal.interruption import Interruption
from msg_analysis.errors import InputError
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.messages import Progress, decode_string

PATIENCE = 1.0  # s after which a note says that there is no network
LISTEN = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""How states are read by default: a writer never waits for such a reader, which misses messages if it is too slow."""


class Watcher(QuietNode):
    """Follows the first run that it hears of; ``known`` is set then, and ``done`` (by subclasses) at its end."""

    def __init__(self, name: str, *, on_note: Callable[[str], None]) -> None:
        super().__init__(name)
        self._on_note = on_note
        self.record: RunRecord | None = None
        self.known, self.done = Future(), Future()
        self._refused: Counter[str] = Counter()
        self._others: set[str] = set()
        self._ended = False
        self._topics: list[str] = []  # topics of states: the run is there while they have publishers
        self.create_subscription(String, EXPERIMENT_TOPIC, self._receive_experiment, LATCHED, raw=True)
        self.create_subscription(ProgressMsg, END_TOPIC, self._receive_end, LATCHED, raw=True)

    def follow(self) -> None:
        """Read the states of the run that has been found; InputError: not possible with this run."""
        raise NotImplementedError

    def farewell(self) -> None:
        """Wait until the readers of this node's own topics have the last messages."""
        raise NotImplementedError

    def conclude(self) -> None:
        """Prepare the final result from what has been received; must be quick, since leaving has a time limit."""

    def _receive_experiment(self, data: bytes) -> None:
        try:
            record = RunRecord.from_json(decode_string(data), f"topic {self.resolve_topic_name(EXPERIMENT_TOPIC)}")
        except (CdrError, InputError) as error:
            self._refused[UNDECODABLE] += 1
            self._on_note(str(error))
            return
        if self.record is None:
            self.record = record
            self.known.set_result(None)
        elif record.run != self.record.run and str(record.run) not in self._others:
            self._others.add(str(record.run))
            self._refused[OTHER_RUN] += 1
            self._on_note(f"another run is there too, {record.run}: only {self.record.run} is watched")

    def _receive_end(self, data: bytes) -> None:
        try:
            run = Progress.decode(data).run
        except CdrError:
            return
        self._ended |= self.record is not None and run == self.record.run.bytes

    def _anybody(self) -> bool:
        return any(self.count_publishers(topic) for topic in self._topics)


Kind = TypeVar("Kind", bound=Watcher)


def run_watcher(
    make_node: Callable[[], Kind],  # called after rclpy.init
    *,
    timeout: float | None = None,
    on_note: Callable[[str], None] = lambda _: None,
    on_look: Callable[[], None] = lambda: None,  # called about every ``SPIN_SLICE`` s, between two callbacks
) -> Kind | None:
    """Watch a network in this process until it is over or a signal comes; None: interrupted before there was a node.

    If the run was seen to be over, the node is still on the network: end the process at once. InputError: no network
    within ``timeout`` s (None: no limit), or it cannot be followed.
    """
    nobody = _nobody()
    os.environ.update(without_shared_memory())
    with ros_arguments():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Kind] = []
    try:
        nodes = [node := make_node()]
        executor = make_executor()
        executor.add_node(node)
        began, noted = time.monotonic(), False
        while not node.known.done():
            on_look()
            executor.spin_until_future_complete(node.known, timeout_sec=SPIN_SLICE)
            waited = time.monotonic() - began
            if timeout is not None and waited > timeout and not node.known.done():
                raise InputError(f"after {timeout:g} s {nobody}: is one running there, or being played?")
            if waited > PATIENCE and not noted and not node.known.done():
                noted = True
                on_note(f"{nobody} yet: waiting for one")
        node.follow()
        _spin(executor, node.done, on_look)
        node.farewell()
    except (KeyboardInterrupt, SystemExit):
        pass
    finally:
        for node in nodes:
            node.conclude()
        # After the run no node waits for this one, and leaving while others leave can deadlock: see ``leave``.
        if not all(node.done.done() for node in nodes):
            leave(nodes, complete=False)
    return nodes[0] if nodes else None


def _spin(executor: Executor, done: Future, on_look: Callable[[], None]) -> None:
    """Spin until ``done``; a signal raises KeyboardInterrupt or SystemExit between two callbacks.

    Raised within a callback, the executor would report it as an error.
    """
    with Interruption() as interruption:
        while not done.done():
            interruption.check()
            on_look()
            executor.spin_until_future_complete(done, timeout_sec=SPIN_SLICE)


def _nobody() -> str:
    domain, reach = os.environ.get("ROS_DOMAIN_ID", "0"), os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    return f"no network in ROS_DOMAIN_ID {domain}, within ROS_AUTOMATIC_DISCOVERY_RANGE {reach}"
