# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Base of the nodes that watch a network, running or played: find the run, follow it, leave when it is over."""

from __future__ import annotations

import faulthandler
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

import rclpy
from rclpy.duration import Duration
from rclpy.executors import Executor
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from msg_agents.discovery.rtps import held_domains
from msg_agents.environment import discovery_scope, without_shared_memory
from msg_agents.nodes.parameters import ros_arguments
from msg_agents.nodes.process import INTERRUPTED_GRACE, SPIN_SLICE, leave, make_executor
from msg_agents.nodes.ros import LeanNode
from msg_agents.terminal import Interruption
from msg_analysis.errors import InputError
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal, decode_of_run, state_frame, state_receiver
from msg_analysis.messages.cdr import CdrError
from msg_analysis.messages.messages import Progress, decode_string
from msg_analysis.messages.topics import Qos, Topic
from msg_analysis.model.run_record import RunRecord

Take = Callable[[int, int, int, bytes, bytes], None]  # of agent from 0, step, mode, state, message

NOTE_DELAY = 1.0  # s after which a note says that there is no network


class Watcher(LeanNode):
    """Follows a run: that of the record, if given, else the first. ``known``: it is there; ``done``: it is over."""

    ack_timeout = 5.0  # s for readers to acknowledge the last message of this node

    def __init__(
        self, name: str, output: Topic, *, on_note: Callable[[str], None], record: RunRecord | None = None
    ) -> None:  # output: the topic that it publishes
        super().__init__(name)
        self._on_note = on_note
        self._writer: Publisher = self.publisher_of(output)
        self.record = record
        self.known, self.done = Future(), Future()
        self._refused: Counter[str] = Counter()
        self._others: set[str] = set()
        self._ended = False
        self._end: int | None = None  # last step of the run, if it has said so
        self._topics: list[str] = []  # topics of states: the run is there while they have publishers
        self.subscribe(topics.EXPERIMENT, self._receive_experiment)
        self.subscribe(topics.END, self._receive_end)
        self.subscribe(topics.STOP, self._take_last_step)

    def follow(self) -> None:
        """Read the states of the run that has been found; InputError: not possible with this run."""
        raise NotImplementedError

    def _subscribe_to_states(self, topic: Topic, qos: Qos, *, whole: bool, take: Take | None = None) -> None:
        """Pass the states of the run to ``_take``, or ``take``; messages that are not of the run are counted."""
        assert self.record is not None
        frame = state_frame(self.record, whole=whole)
        for agent in range(self.record.experiment.agents):
            self._topics.append(self.resolve_topic_name(topic.of(agent)))
            receive = state_receiver(self.record, agent, frame, take or self._take, self._refuse)
            self.subscribe(topic, receive, agent=agent, qos=qos)

    def _take(self, agent: int, step: int, mode: int, state: bytes, message: bytes) -> None:
        """Take a state of an agent (index from 0). Hot path."""
        raise NotImplementedError

    def _refuse(self, reason: str) -> None:
        self._refused[reason] += 1

    def wait_for_readers(self) -> None:
        """Wait until the readers of this node's own topic have the last message."""
        self._writer.wait_for_all_acked(Duration(seconds=self.ack_timeout))

    def take_outcome(self) -> None:
        """Prepare the final result from what has been received; must be quick, since leaving has a time limit."""

    def _receive_experiment(self, data: bytes) -> None:
        try:
            record = RunRecord.from_json(
                decode_string(data), f"topic {self.resolve_topic_name(topics.EXPERIMENT.name)}"
            )
        except (CdrError, InputError) as error:
            self._refused[Refusal.UNDECODABLE] += 1
            self._on_note(str(error))
            return
        if self.record is None:
            self.record = record
            self.known.set_result(None)
        elif record.run != self.record.run and str(record.run) not in self._others:
            self._others.add(str(record.run))
            self._refused[Refusal.OTHER_RUN] += 1
            self._on_note(f"there is a second run, {record.run}: only {self.record.run} is watched")
        elif record.run == self.record.run and record.to_json() != self.record.to_json():
            if not self._refused[Refusal.CONTRADICTION]:
                self._on_note(f"there are two records of run {record.run}, and one is forged: the first is used")
            self._refused[Refusal.CONTRADICTION] += 1

    @property
    def last_step(self) -> int:
        """The last step of the run that is known, as far as it is known that it ends early."""
        assert self.record is not None
        planned = self.record.experiment.steps
        return planned if self._end is None else min(self._end, planned)

    def _receive_end(self, data: bytes) -> None:
        self._ended = self._take_last_step(data) or self._ended

    def _take_last_step(self, data: bytes) -> bool:
        """Take the last step of the run; False: of another one."""
        if self.record is None:
            return False
        found = decode_of_run(Progress, data, self.record.run.bytes)
        if not isinstance(found, Progress):
            return False
        if self.record.until is not None and found.step != self._end:
            self._end = found.step
            self._ends()
        return True

    def _ends(self) -> None:
        """The run has said at which step it ends: ``last_step``."""

    def look(self) -> None:
        """Look whether the run whose record was given is there."""
        if self._topics and not self.known.done() and self._has_publishers():
            self.known.set_result(None)

    def _finish_if_over(self, *, all_there: bool, quiet: bool) -> None:
        """Finish if all states have arrived, or no more will: the run has ended, or its publishers have gone."""
        over = all_there or (quiet and (self._ended or not self._has_publishers()))
        if over and not self.done.done():
            self.done.set_result(None)

    def _has_publishers(self) -> bool:
        return any(self.count_publishers(topic) for topic in self._topics)


Kind = TypeVar("Kind", bound=Watcher)


def run_watcher(
    make_node: Callable[[], Kind],  # called after rclpy.init
    *,
    timeout: float | None,  # s to wait for a network; None: no limit
    on_note: Callable[[str], None],
    on_look: Callable[[], None] = lambda: None,  # called about every ``SPIN_SLICE`` s, between two callbacks
) -> Kind | None:
    """Watch a network in this process until it is over or a signal comes; None: interrupted before there was a node."""
    # If the run was seen to be over, the node is still on the network: the caller has to end the process at once.
    no_network = f"no network {discovery_scope()}"
    os.environ.update(without_shared_memory())
    with ros_arguments():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Kind] = []
    executor: Executor | None = None
    try:
        nodes = [node := make_node()]
        executor = make_executor()
        executor.add_node(node)
        followed = node.record is not None
        if followed:  # at once: a player may wait for nobody
            node.follow()
        began, noted = time.monotonic(), False
        while not node.known.done():
            on_look()
            node.look()
            executor.spin_until_future_complete(node.known, timeout_sec=SPIN_SLICE)
            waited = time.monotonic() - began
            if timeout is not None and waited > timeout and not node.known.done():
                raise InputError(
                    f"after {timeout:g} s {no_network}: is one running or being played there? {_other_domain()}"
                )
            if waited > NOTE_DELAY and not noted and not node.known.done():
                noted = True
                on_note(f"{no_network} yet: waiting for one. {_other_domain()}")
        if not followed:
            node.follow()
        with Interruption() as interruption:  # raised within a callback, the executor would report it as an error
            while not node.done.done():
                interruption.check()
                on_look()
                executor.spin_until_future_complete(node.done, timeout_sec=SPIN_SLICE)
        node.wait_for_readers()
    except (KeyboardInterrupt, SystemExit):
        pass
    finally:
        for node in nodes:
            node.take_outcome()
        if all(node.done.done() for node in nodes):
            _stop_reading(nodes, executor)
        else:
            leave(nodes, executor, complete=False)
    return nodes[0] if nodes else None


def _other_domain() -> str:
    mine = os.environ.get("ROS_DOMAIN_ID") or "0"
    found = [str(domain) for domain in held_domains() if str(domain) != mine]
    return "Another domain: --domain D" + (f"; runs on this machine are in {', '.join(found)}" if found else "")


def _stop_reading(nodes: Sequence[Watcher], executor: Executor | None) -> None:
    """Remove the readers from the network: who publishes to them would wait until the middleware drops them, 20 s."""
    # The participant stays until the end of the process: to remove it while others leave can deadlock, see ``leave``.
    faulthandler.dump_traceback_later(INTERRUPTED_GRACE, exit=True)  # should that happen here, too
    if executor is not None:
        executor.shutdown()
    for node in nodes:
        for subscription in list(node.subscriptions):
            node.destroy_subscription(subscription)
    faulthandler.cancel_dump_traceback_later()
