# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The life of one process of a network: nodes, start gate, spin, end, which a hanging middleware does not prevent."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from msg_agents.discovery.relay import report_ready
from msg_agents.discovery.rtps import PREFIX_SIZE, remove_participant
from msg_agents.environment import discovery_scope
from msg_agents.nodes.base import ACK_TIMEOUT, HealthReporter, NetworkNode, PeerPresence
from msg_agents.nodes.parameters import ros_arguments
from msg_agents.recovery import Takeover
from msg_agents.run.fork_server import ends_at_once, show_stacks_when_asked
from msg_analysis.errors import InputError

FIRST_POLL, GATE_POLL = 0.005, 0.2  # s; a tight loop on the ROS graph starves discovery where many processes look
PAUSE_PER_LOOK = 40  # times as long as a look took, which is longer the more processes compete for the cores
SPIN_SLICE = 0.5  # s; without a time-out EventsExecutor.spin of Jazzy never wakes up
GC_THRESHOLD = 50_000  # objects; the hot path makes no cycles, so young collections find nothing
LEAVE_GRACE = 5  # s
INTERRUPTED_GRACE = 15  # s; longer, because a process that ends by it has failed
USE_SIM_TIME = ["--ros-args", "-p", "use_sim_time:=true"]
SIGEV_THREAD = 2  # of <signal.h>: the C library calls a function in a thread of its own
_LEFT: list[object] = []  # what must not be taken down before the end of the process


class _Event(ctypes.Structure):
    """``struct sigevent`` of Linux, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_byte * 32),
    )


def exit_after(seconds: int) -> None:
    """End this process with exit code 0 in so many seconds, unless it has ended by then."""
    # Neither the interpreter's lock nor the interpreter is needed. C libraries without such timers do nothing.
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "timer_create"):
        return
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # there is none, or nobody reads it any more
            stream.flush()
    function = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _Event(notify=SIGEV_THREAD, function=function.value)  # its value, 0, is what _exit is called with
    timer = ctypes.c_void_p()
    in_time = (ctypes.c_long * 4)(0, 0, seconds, 0)  # interval and time to the end, each in s and ns
    if library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        library.timer_settime(timer, 0, in_time, None)


class NotFoundError(InputError):
    """Some nodes of the run were not discovered in time."""


def make_executor(kind: str = "events") -> Executor:
    """The events executor where this rclpy has it, else or for comparison ("single") the single-threaded one."""
    if kind == "events":
        with contextlib.suppress(ImportError):  # a third of the CPU time per message
            from rclpy.experimental.events_executor import EventsExecutor

            return EventsExecutor()
    return SingleThreadedExecutor()


def prefer_throughput() -> None:
    """Ask the scheduler for throughput instead of immediate wake-ups (Linux: SCHED_BATCH)."""
    # In lockstep all cores are busy with processes that wake each other with every message; if each wake-up preempts
    # the running process, a third of the time goes into the switches. Threads made later inherit the policy.
    with contextlib.suppress(AttributeError, OSError):  # other systems have no such policy
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def run_nodes(
    make_nodes: Callable[[], Sequence[NetworkNode]],  # called after rclpy.init
    *,
    executor: str = "events",  # or "single"
    discovery_timeout: float,  # s
    throughput: bool = True,  # see ``prefer_throughput``
    use_sim_time: bool = False,
    status_file: Path | None = None,  # written once a second and at the end
    relay: int | None = None,  # descriptor of ``DiscoveryRelay``
    peer_timeout: float | None = None,  # s, see ``PeerPresence``; None: no limit
    one_record: bool = True,  # whether one process gave all of them their record, so that it need not be compared
) -> bool:
    """Run nodes until each has done its part; False if the process was stopped (SIGINT, SIGTERM) before."""
    show_stacks_when_asked()
    # Python's own handler would raise KeyboardInterrupt anywhere, in the middle of a write for example. ROS's handler,
    # installed on top, ends the spin between two callbacks.
    signals: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: signals.append(number))
    if throughput:
        prefer_throughput()
    arguments = [*sys.argv, *(USE_SIM_TIME if use_sim_time else [])]
    handlers = SignalHandlerOptions.ALL
    if peer_timeout is not None:  # with ROS's handler, nothing could be published after a signal: see ``leave``
        signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
        handlers = SignalHandlerOptions.NO
    with ros_arguments():
        rclpy.init(args=arguments, signal_handler_options=handlers)
    nodes: Sequence[NetworkNode] = []
    prefix = b""  # of a process that the relay connects
    reporter: HealthReporter | None = None
    presence: PeerPresence | None = None
    spinner: Executor | None = None
    complete = False
    try:
        if signals:  # before ROS's handler was there
            raise ExternalShutdownException
        nodes = make_nodes()
        if relay is not None:
            prefix = own_prefix(nodes[0])
            report_ready(relay, nodes[0].get_name(), prefix)
        if not one_record:
            nodes[0].compare_record()
        reporter = HealthReporter(nodes, status_file)
        presence = None if peer_timeout is None else PeerPresence(nodes, peer_timeout)
        spinner = make_executor(executor)
        for node in nodes:
            spinner.add_node(node)
        _gate(nodes, discovery_timeout, signals)
        # All objects made so far live until the end: the garbage collector need not scan them again and again.
        gc.collect()
        gc.freeze()
        gc.set_threshold(GC_THRESHOLD)
        for node in nodes:
            node.begin()
        if presence is not None:
            presence.begin()
        for node in nodes:
            while not node.done.done():
                if signals:
                    raise ExternalShutdownException
                spinner.spin_until_future_complete(node.done, timeout_sec=SPIN_SLICE)
            node.done.result()
        complete = True
    except ExternalShutdownException:
        pass
    except (RuntimeError, NotInitializedException):  # RCLError among them: a signal came in the middle of a call
        if rclpy.ok():
            raise
    finally:
        if presence is not None and not complete and rclpy.ok():
            presence.leave()
        deadline = time.monotonic() + ACK_TIMEOUT
        for node in nodes:
            node.finish(complete=complete, deadline=deadline)
        if reporter:
            reporter.write_status_file()
        # Launchers without a terminal pass on a SIGINT that all have got. Python gives it its default action while it
        # ends, unless it is ignored: the process would be killed before the middleware has removed its shared memory.
        # The C library first: a signal that came while Python replaces its handler would be printed as an error.
        ctypes.CDLL(None).signal(signal.SIGINT, ctypes.c_void_p(signal.SIG_IGN))
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if prefix and ends_at_once():
            leave_at_once(nodes, spinner, prefix)
        else:
            leave(nodes, spinner, complete=complete)
    return complete


def own_prefix(node: Node) -> bytes:
    """The prefix of the GUIDs of this process; empty: not known, since another node has the same name."""
    own = (node.get_name(), node.get_namespace())
    endpoints = [p for topic in node.publishers for p in node.get_publishers_info_by_topic(topic.topic_name)]
    prefixes = {bytes(p.endpoint_gid[:PREFIX_SIZE]) for p in endpoints if (p.node_name, p.node_namespace) == own}
    return prefixes.pop() if len(prefixes) == 1 else b""


def store_participant(takeovers: Sequence[Takeover], node: Node) -> None:
    """Store the GUID prefix of this process for a later takeover; without one, that will remove no process."""
    prefix = own_prefix(node) if takeovers else b""
    for takeover in takeovers if prefix else ():
        takeover.store_prefix(prefix)


def leave(nodes: Sequence[Node], executor: Executor | None, *, complete: bool) -> None:
    """Remove the nodes from the network, so that no other node waits for them, and make sure that the process ends."""
    # When many participants leave at once, Fast DDS 2.14 can deadlock in DomainParticipant::set_listener, with the
    # interpreter's lock held or after the interpreter has gone. Then only C code helps. Nothing is lost, because a
    # complete process has delivered everything by now.
    if complete:
        exit_after(LEAVE_GRACE)
    else:
        faulthandler.dump_traceback_later(INTERRUPTED_GRACE, exit=True)
    if executor is not None:  # as long as it has a node, the middleware keeps that, and the others are not informed
        executor.shutdown()
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def leave_at_once(nodes: Sequence[Node], executor: Executor | None, prefix: bytes) -> None:
    """Let the end of this process be its removal from the network, in one message to each of the others."""
    # For processes that the relay knows, which have no shared memory. Otherwise each endpoint's end would be announced
    # to each of them: in a large network more messages than all the rest.
    _LEFT.extend([executor, *nodes])
    atexit.register(remove_participant, prefix, int(os.environ.get("ROS_DOMAIN_ID") or 0), repeats=1)
    rclpy.try_shutdown()


def _gate(nodes: Sequence[NetworkNode], timeout: float, signals: Sequence[int]) -> None:
    """Wait until the publishers of all nodes have found their readers, and every name belongs to one node only."""
    # Readers are identified by name: with duplicates, a run might start without the node that belongs to it.
    deadline = time.monotonic() + timeout
    waiting = list(nodes)
    warned = False
    while True:
        begun = time.monotonic()
        waiting = [node for node in waiting if not node.discovered_all() or node.missing_clock()]
        late = time.monotonic() > deadline
        twice = nodes[0].duplicate_names() if late or not waiting else []
        if not waiting and not twice:
            return
        if twice and not warned:
            warned = True
            names = ", ".join(twice)
            nodes[0].get_logger().warning(f"more than one node is called {names}: waiting until only one is left")
        if late and twice:
            raise nodes[0].duplicate_name_error(twice, timeout)
        if late:
            missing = sorted({name for node in waiting for name in node.missing_nodes() + node.missing_clock()})
            raise NotFoundError(
                f"after {timeout:g} s {', '.join(node.get_name() for node in waiting)} did not discover: "
                f"{', '.join(missing)}. Are they running {discovery_scope()}?"
            )
        if signals or not rclpy.ok():  # the wait is interrupted
            raise ExternalShutdownException
        time.sleep(min(max(FIRST_POLL, PAUSE_PER_LOOK * (time.monotonic() - begun)), GATE_POLL))
