# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""rclpy: nodes without parameter services, timers, QoS, errors."""

from __future__ import annotations

import copy
import importlib.util
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import rclpy
from msg_agents_interfaces.msg import AgentState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.type_support import check_for_type_support
from rosgraph_msgs.msg import Clock as ClockMessage

from msg_agents.nodes.parameters import PROCESS
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import show
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.topics import CLOCK, Qos, Topic


def use_middleware() -> None:
    """Load rclpy's middleware and the messages; raises whatever goes wrong."""
    rclpy.init()
    rclpy.shutdown()
    check_for_type_support(AgentState)


try:
    from rclpy._rclpy_pybind11 import RCLError
except ImportError:  # rclpy of other distributions
    from rclpy.impl.implementation_singleton import rclpy_implementation

    RCLError = rclpy_implementation.RCLError

__all__ = ["RCLError", "until_shutdown"]


@contextmanager
def until_shutdown(node: Node) -> Iterator[None]:
    """Drop what cannot be published any more: a signal has shut rclpy down in the middle of a callback."""
    try:
        yield
    except RCLError:  # the executor would print it as FATAL, with a stack
        if node.context.ok():
            raise


def ros_profile(qos: Qos) -> QoSProfile:
    """The profile for rclpy."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if qos.depth is None else HistoryPolicy.KEEP_LAST,
        depth=qos.depth or 0,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    )


FAR_OFF = 3600.0  # s


class DueTimer:
    """Calls back once, when the node's clock (a wall clock, or ``/clock`` under use_sim_time) has reached a time."""

    # ROS 2's own timers are periodic and count from when they were made. This one is set anew for every time, so it
    # does not drift and has the phase that was asked for. The callback may come a little late.
    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._clock = cast(ROSClock, node.get_clock())
        self._callback = callback
        self._timer = node.create_timer(FAR_OFF, self._fire)
        self._timer.cancel()

    def now(self) -> int:
        """Time of the clock [ns]; 0 under use_sim_time until ``/clock`` has been received."""
        if self._clock.ros_time_is_active:
            return int(self._clock.now().nanoseconds)
        return time.time_ns()  # what that clock reads then, in a third of the time

    def set(self, when: int, now: int | None = None) -> None:
        """Call back at time ``when`` of the clock [ns], at once if it has passed; ``now``: its time, if known."""
        # The clock may have moved on from ``now``: the callback is then a little later.
        self._timer.timer_period_ns = max(1, when - (self.now() if now is None else now))
        self._timer.reset()

    def _fire(self) -> None:
        self._timer.cancel()
        self._callback()


def every(node: Node, period: float, callback: Callable[[], None]) -> None:
    """Call back every ``period`` s of wall time, from the node's executor, even while the node's clock is stopped."""
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def after(node: Node, seconds: float, callback: Callable[[], None]) -> None:
    """Call back once, after so many seconds of wall time."""

    def fire() -> None:
        node.destroy_timer(timer)
        callback()

    timer = node.create_timer(seconds, fire, clock=Clock(clock_type=ClockType.STEADY_TIME))


def message_class(type_name: str) -> Any:
    """Class of a type of our own code, such as std_msgs/msg/String."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def foreign_message_class(type_name: str) -> Any:
    """Class of a type that a file names; InputError where no installed package of interfaces has such a message."""
    # Nothing is imported but what the index of ROS registers as interfaces, from where it is registered.
    package, _, name = type_name.partition("/msg/")
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    if re.fullmatch("[a-z][a-z0-9_]*", package) and any(_is_registered(Path(each), package, name) for each in prefixes):
        try:
            kind = message_class(type_name)
            check_for_type_support(kind)
            return kind
        except Exception as error:  # of code that we know nothing about
            raise InputError(f"the type {show(type_name)} cannot be loaded: {error}") from error
    raise InputError(f"the type {show(type_name)} is not installed here")


def _is_registered(prefix: Path, package: str, name: str) -> bool:
    """Whether an installation lists a message, and an import would find its package there."""
    try:
        listed = (prefix / "share/ament_index/resource_index/rosidl_interfaces" / package).read_text(encoding="utf-8")
        spec = importlib.util.find_spec(package)  # imports nothing
    except (OSError, ValueError):
        return False
    if not {f"msg/{name}.idl", f"msg/{name}.msg"} & set(listed.split()) or spec is None:
        return False
    places = [Path(each) for each in spec.submodule_search_locations or ()]
    return bool(places) and all(
        each.is_relative_to(prefix) or each.resolve().is_relative_to(prefix.resolve()) for each in places
    )


def load_type_support(topics: Iterable[Topic]) -> None:
    """Load what rclpy loads when a topic of this type is first used."""
    for topic in topics:
        check_for_type_support(message_class(topic.type.full_name))


class LeanNode(Node):  # type: ignore[misc]  # rclpy has no type hints that mypy can follow
    """A node without parameter services, type descriptions and /rosout; its parameters are declared all the same."""

    # Seven services and /rosout cost more than the network if there are many nodes.
    def __init__(self, name: str) -> None:
        self._takes_overrides = False  # rclpy cannot handle overrides yet when it makes the node's own topics
        super().__init__(
            name,
            start_parameter_services=bool(PROCESS.values.get("parameter_services")),
            enable_rosout=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
        self._takes_overrides = PROCESS.qos_overrides
        PROCESS.declare(self)

    def publisher_of(self, topic: Topic, agent: int = 0) -> Publisher:
        """A publisher of a topic; ``agent`` (index from 0) where every agent has one."""
        return self.create_publisher(message_class(topic.type.full_name), topic.of(agent), ros_profile(topic.qos))

    def subscribe(
        self, topic: Topic, callback: Callable[[bytes], object], *, agent: int = 0, qos: Qos | None = None
    ) -> Subscription:
        """Pass the messages of a topic on as CDR bytes; ``qos``: if not that of the topic."""
        kind, profile = message_class(topic.type.full_name), ros_profile(qos or topic.qos)
        return self.create_subscription(kind, topic.of(agent), callback, profile, raw=True)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Publisher:
        """As in rclpy; with the user's overrides of the quality of service, as far as no message would be lost."""
        names = ("DEADLINE", "LIFESPAN", "LIVELINESS", "LIVELINESS_LEASE_DURATION")
        kinds = [QoSPolicyKind[name] for name in names]
        return self._create(super().create_publisher, kinds, msg_type, topic, qos_profile, **options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[Any], object], qos_profile: Any, **options: Any
    ) -> Subscription:
        """As in rclpy; overrides as in ``create_publisher``."""
        create = super().create_subscription
        if msg_type is ClockMessage:  # of rclpy itself, under use_sim_time
            callback = self._if_not_negative(callback)
        return self._create(
            lambda kind, name, qos, **more: create(kind, name, callback, qos, **more),
            [],
            msg_type,
            topic,
            qos_profile,
            **options,
        )

    def _if_not_negative(self, take: Callable[[Any], object]) -> Callable[[Any], None]:
        """``take`` for messages of ``/clock`` without those with a negative time, of which rclpy makes a ValueError."""

        def receive(message: Any) -> None:
            if message.clock.sec < 0:
                self.refuse(Refusal.NEGATIVE_TIME, CLOCK.name)
            else:
                take(message)

        return receive

    def refuse(self, reason: str, topic: str) -> None:
        """Note that a message was refused."""

    def _create(
        self,
        create: Callable[..., Any],
        kinds: list[QoSPolicyKind],
        msg_type: Any,
        topic: str,
        qos: Any,
        **options: Any,
    ) -> Any:
        if not self._takes_overrides:
            return create(msg_type, topic, qos, **options)
        qos = copy.copy(qos) if isinstance(qos, QoSProfile) else QoSProfile(depth=qos)  # rclpy changes it in place
        before, publishes = copy.copy(qos), bool(kinds)
        kinds = [QoSPolicyKind.HISTORY, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY, *kinds]
        if before.history != HistoryPolicy.KEEP_ALL:  # depth has no meaning there
            kinds.append(QoSPolicyKind.DEPTH)
        # The parameters go by the resolved name of the topic.
        final = self.resolve_topic_name(topic)

        def check(profile: QoSProfile) -> SetParametersResult:
            reason = objection(before, profile, publishes=publishes)
            return SetParametersResult(successful=not reason, reason=reason)

        overriding = QoSOverridingOptions(kinds, callback=check)
        try:
            return create(msg_type, topic, qos, qos_overriding_options=overriding, **options)
        except (InvalidQosOverridesError, RuntimeError) as error:
            if not isinstance(error, InvalidQosOverridesError) and "QoS override" not in str(error):
                raise
            side = "publisher" if publishes else "subscription"
            reason = str(error).partition("not valid: ")[2] or str(error)
            raise InputError(f"parameter qos_overrides.{final}.{side}: {reason}") from error

    def publish(self, publisher: Publisher, data: bytes) -> None:
        """Publish CDR bytes on a reliable, keep-all publisher, again until they go through or this process ends."""
        while True:
            try:
                # What Publisher.publish does with bytes, without entering the handle's context each time.
                publisher.handle.publish_raw(data)
                return
            except RCLError:  # a slow reader blocks such a writer: after 100 ms, the message has not been written
                if not self.context.ok():  # see ``until_shutdown``
                    return


def objection(before: QoSProfile, after: QoSProfile, *, publishes: bool) -> str:
    """Why a quality of service may not be overridden so, or empty text; publishers may become latched."""
    if before.history != HistoryPolicy.KEEP_ALL:  # messages may be lost there anyway
        return ""
    for policy in ("history", "reliability", "durability", "lifespan"):
        ours, theirs = getattr(before, policy), getattr(after, policy)
        latched_as_well = policy == "durability" and publishes and theirs.name == "TRANSIENT_LOCAL"
        if theirs != ours and not latched_as_well:
            names = [str(getattr(value, "name", value)).lower() for value in (theirs, ours)]
            return f"{policy}: {names[0]}: messages of the run would be lost or never arrive: expected {names[1]}"
    return ""


FRAME = "map"  # of positions


def state_messages(node: Node, kind: str, frame: str | None) -> tuple[type[Any], Callable[[float], Any]]:
    """A type of messages for programs that know nothing of this software, by ``hears`` of a map, and its messages.

    x is the state. They are stamped with the time of the node's clock; the orientation of a pose is the identity.
    """
    from geometry_msgs.msg import Point, PointStamped, Pose, PoseStamped  # here, since few processes need them
    from std_msgs.msg import Float64, Header

    def header() -> Header:
        return Header(stamp=node.get_clock().now().to_msg(), frame_id=frame or FRAME)

    kinds: dict[str, tuple[type[Any], Callable[[float], Any]]] = {
        "number": (Float64, lambda x: Float64(data=x)),
        "point": (PointStamped, lambda x: PointStamped(header=header(), point=Point(x=x))),
        "pose": (PoseStamped, lambda x: PoseStamped(header=header(), pose=Pose(position=Point(x=x)))),
    }
    return kinds[kind]
