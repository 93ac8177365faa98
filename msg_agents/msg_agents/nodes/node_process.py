"""The life of one process of a network: nodes, start gate, spin, end."""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from msg_agents.nodes.diagnostics import Reporter
from msg_agents.nodes.network_node import FAREWELL, NetworkNode
from msg_agents.nodes.peer_presence import Presence
from msg_agents.nodes.ros.node_parameters import ros_arguments
from msg_agents.recovery.takeover import PREFIX_SIZE, Succession
from msg_analysis.errors import InputError

GATE_POLL = 0.2  # s; a tighter loop on the ROS graph starves discovery on a small machine
SPIN_SLICE = 0.5  # s; without a time-out EventsExecutor.spin of Jazzy never wakes up
GC_THRESHOLD = 50_000  # objects; the hot path makes no cycles, so young collections find nothing
LEAVE_GRACE = 5  # s
INTERRUPTED_GRACE = 15  # s; longer, since what ends by it has not ended in order
LIFELINE_GRACE = 5.0  # s
USE_SIM_TIME = ["--ros-args", "-p", "use_sim_time:=true"]


class NotFoundError(InputError):
    """Some nodes of the run were not discovered in time."""


def make_executor(kind: str = "events") -> Executor:
    """The events executor where this rclpy has it (a third of the CPU per message), else the single-threaded one.

    Parameters
    ----------
    kind
        "events" or "single"; "single" is there for comparison
    """
    if kind == "events":
        try:
            from rclpy.experimental.events_executor import EventsExecutor
        except ImportError:
            pass
        else:
            return EventsExecutor()
    return SingleThreadedExecutor()


def prefer_throughput() -> None:
    """Tell the scheduler that this process is after throughput, not after being woken at once (Linux: SCHED_BATCH).

    A lockstep network keeps every core busy with processes that wake each other with every message; when each wake-up
    interrupts whoever is running, a third of the time goes into the change. Threads made later inherit the policy.
    """
    with contextlib.suppress(AttributeError, OSError):  # other systems have no such policy
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def hold_lifeline(descriptor: int) -> None:
    """End this process when the other end of a pipe closes, that is when the parent is gone, however it went.

    Parameters
    ----------
    descriptor
        of the end of the pipe that this process has
    """

    def watch() -> None:
        while os.read(descriptor, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(LIFELINE_GRACE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="lifeline").start()


def run_nodes(
    make_nodes: Callable[[], Sequence[NetworkNode]],
    *,
    executor: str = "events",
    discovery_timeout: float,
    throughput: bool = True,
    use_sim_time: bool = False,
    account: Path | None = None,
    patience: float | None = None,
) -> bool:
    """Run nodes in this process until each has done its part.

    Parameters
    ----------
    make_nodes
        called once ROS is up
    executor
        "events" or "single"
    discovery_timeout
        s to wait for the other nodes of the run
    throughput
        whether much work in little time counts for more than being woken at once
    use_sim_time
        whether the nodes take the time from ``/clock``; as the ROS parameter of that name
    account
        file that says once a second, and at the end, what the nodes have refused and what they wait for
    patience
        s after which it ends when it has been left alone; None: never

    Returns
    -------
    bool
        True if all nodes did their part, False if the process was told to stop (SIGINT, SIGTERM) before

    Raises
    ------
    NotFoundError
        with the names of who is missing
    InputError
        what a node failed with, or the names of who is there twice
    """
    # Python's own handler would raise KeyboardInterrupt anywhere, in the middle of a write for example. ROS's handler,
    # installed on top, ends the spin between two callbacks.
    signal.signal(signal.SIGINT, lambda *_: None)
    if throughput:
        prefer_throughput()
    with ros_arguments():
        rclpy.init(args=[*sys.argv, *(USE_SIM_TIME if use_sim_time else [])])
    nodes: Sequence[NetworkNode] = []
    reporter: Reporter | None = None
    complete = False
    try:
        nodes = make_nodes()
        reporter = Reporter(nodes, account)
        spinner = make_executor(executor)
        for node in nodes:
            spinner.add_node(node)
        _gate(nodes, discovery_timeout)
        # All that stands now stands until the end: the garbage collector need not look at it again, at every step.
        gc.collect()
        gc.freeze()
        gc.set_threshold(GC_THRESHOLD)
        for node in nodes:
            node.begin()
        if patience is not None:
            Presence(nodes[0], patience)
        for node in nodes:
            while not node.done.done():
                spinner.spin_until_future_complete(node.done, timeout_sec=SPIN_SLICE)
            node.done.result()
        complete = True
    except ExternalShutdownException:
        pass
    except (RuntimeError, NotInitializedException):  # RCLError among them: of whatever a signal has come in between
        if rclpy.ok():
            raise
    finally:
        deadline = time.monotonic() + FAREWELL
        for node in nodes:
            node.finish(complete=complete, deadline=deadline)
        if reporter:
            reporter.keep_account()
        leave(nodes, complete=complete)
    return complete


def enter_participant(successions: Sequence[Succession], node: Node) -> None:
    """Note the name of this process, which the endpoints of its nodes bear, for the one that will follow.

    Parameters
    ----------
    successions
        of the nodes of this process
    node
        one of them
    """
    if not successions:
        return
    own = (node.get_name(), node.get_namespace())
    endpoints = [p for topic in node.publishers for p in node.get_publishers_info_by_topic(topic.topic_name)]
    prefixes = {bytes(p.endpoint_gid[:PREFIX_SIZE]) for p in endpoints if (p.node_name, p.node_namespace) == own}
    if len(prefixes) == 1:  # else somebody bears the same name: nobody is buried for him
        for succession in successions:
            succession.enter(*prefixes)


def leave(nodes: Sequence[Node], *, complete: bool) -> None:
    """Take the nodes off the network, so that nobody waits for them, and see to it that the process ends.

    When many participants leave at once, Fast DDS 2.14 can deadlock in DomainParticipant::set_listener, with the
    interpreter's lock or after the interpreter has gone. Only what runs in C helps then: an alarm, whose default action
    ends the process. All that the process owed to others it has given by now, so nothing is lost.

    Parameters
    ----------
    nodes
        of this process
    complete
        whether they have done their part
    """
    if complete:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LEAVE_GRACE)
    else:
        faulthandler.dump_traceback_later(INTERRUPTED_GRACE, exit=True)
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def _gate(nodes: Sequence[NetworkNode], timeout: float) -> None:
    """Wait until the publishers of all nodes have found their readers, and every name belongs to one node only.

    Readers are told by their names. Where two bear the same one, a run might start without the one that belongs to it.
    """
    deadline = time.monotonic() + timeout
    waiting = list(nodes)
    warned = False
    while True:
        waiting = [node for node in waiting if not node.found() or node.awaited_clock()]
        late = time.monotonic() > deadline
        twice = nodes[0].namesakes() if late or not waiting else []
        if not waiting and not twice:
            return
        if twice and not warned:
            warned = True
            names = ", ".join(twice)
            nodes[0].get_logger().warning(f"there is more than one {names}: waiting until only one is left")
        if late and twice:
            raise nodes[0].clash(twice, timeout)
        if late:
            missing = sorted({name for node in waiting for name in node.awaited() + node.awaited_clock()})
            raise NotFoundError(
                f"after {timeout:g} s {', '.join(node.get_name() for node in waiting)} had not found: "
                f"{', '.join(missing)}. Are they running, in the same ROS_DOMAIN_ID "
                f"({os.environ.get('ROS_DOMAIN_ID', '0')}) and within ROS_AUTOMATIC_DISCOVERY_RANGE "
                f"({os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')})?"
            )
        if not rclpy.ok():
            raise ExternalShutdownException
        time.sleep(GATE_POLL)
