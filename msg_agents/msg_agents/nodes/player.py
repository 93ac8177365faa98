# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The player: publishes the messages of a bag again, for the readers that it is to wait for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from msg_agents.environment import discovery_scope
from msg_agents.nodes.parameters import ros_arguments
from msg_agents.nodes.process import leave
from msg_agents.nodes.ros import LeanNode, RCLError, foreign_message_class, ros_profile
from msg_agents.replay import BagClock, parse_remaps, problem_of_name, select_topics
from msg_agents.terminal import Interruption, JobControl, Keyboard
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.playback import BagTopic, Message, Playback
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import show
from msg_analysis.messages.topics import CLOCK, LATCHED, STREAM

SETTLED = 0.8  # s without a change in the readers, after which discovery counts as finished
SETTLE_LIMIT = 5.0  # s after which it counts as finished in any case
NOTE_DELAY = 2.0  # s after which a note says what is missing
LONGEST_POLL = 1.0  # s; a longer gap between two looks counts as this much: the process was stopped
DISCOVERY_POLL = 0.2  # s; a tighter loop on the ROS graph starves discovery on a small machine
CHECK_PERIOD = 0.05  # s between two checks of keyboard and clock
STOPPED_AFTER = 1.0  # s without a check, after which the process is taken to have been stopped
PROGRESS_PERIOD = 0.2  # s between two reports of progress
ACK_SLICE = 0.2  # s
ACK_NOTE_DELAY = 5.0  # s for readers to acknowledge the end before a note; the middleware may ask them only after 3 s
BLOCKED_AFTER = 0.05  # s to publish one message, from which on a reader is holding the player back
FINAL_BEFORE = 0.05  # s; an error that comes sooner is final: a slow reader blocks for 100 ms
RATE_STEP = 1.1
SEEK_SHARE = 0.05  # of the played part, by one key
MOST_TYPED = 12  # characters of a time


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayOptions:
    """How a bag is played."""

    rate: float = 1.0  # seconds of the bag per second; inf: as fast as the readers take it
    start_offset: float = 0.0  # s of the bag left out at the beginning
    duration: float | None = None  # s of the bag that are played; None: all of the rest
    loop: bool = False
    paused: bool = False  # whether to start paused
    clock: float | None = None  # Hz at which ``/clock`` is published; None: not
    topics: Sequence[str] = ()  # see ``select_topics``, also for ``exclude``
    exclude: Sequence[str] = ()
    remaps: Sequence[str] = ()  # see ``parse_remaps``
    subscribers: int = 0  # readers that every topic must have before playing begins; latched ones need none
    readers: Sequence[str] = ()  # names of nodes that must read every such topic
    wait_timeout: float = 30.0  # s to wait for them


@dataclass(slots=True)
class Played:
    """What has been played so far."""

    messages: int = 0  # published
    seconds: float = 0.0  # of wall time since playing began
    held_back: float = 0.0  # s of these in which readers did not take what was published
    now: float = 0.0  # s from the start of the bag
    length: float = 0.0  # s of the whole bag
    rate: float = 1.0  # s of the bag per second
    paused: bool = False
    typed: str = ""  # a time to go to that is being typed
    begun: bool = False  # whether the required readers were there


def message_classes(
    topics: Iterable[BagTopic], names: Mapping[str, str], *, all_wanted: bool, on_note: Callable[[str], None]
) -> dict[str, Any]:
    """Message classes by name of the topics that can be played as ``names`` say: of all if they were chosen."""
    found, unplayable = {}, []
    for topic in topics:
        if topic.encoding != "cdr":
            unplayable.append(f"{topic.name} (the encoding of its messages is {topic.encoding or 'unknown'}, not cdr)")
            continue
        if not topic.type_name:
            unplayable.append(f"{topic.name} (the type of its messages is not in the bag)")
            continue
        if problem := problem_of_name(names[topic.name]):
            unplayable.append(f"{show(topic.name)} ({problem})")
            continue
        try:
            found[topic.name] = foreign_message_class(topic.type_name)
        except InputError as error:
            unplayable.append(f"{topic.name} ({error})")
    if unplayable and (all_wanted or not found):
        raise InputError(
            f"cannot be played: {', '.join(unplayable)}: install missing types, rename topics with --remap, or leave "
            "them out with --exclude"
        )
    for line in unplayable:
        on_note(f"not played: {line}")
    return found


class Player(LeanNode):
    """Publishes the messages of a bag: the same bytes, in the same order on each topic, without loss."""

    # All topics are reliable and keep-all, however they were recorded: best-effort readers match too, and a slow
    # reliable one holds the player back. Topics recorded as latched are latched. The node receives nothing, so nothing
    # spins.
    def __init__(
        self,
        bag: Playback,
        options: PlayOptions,
        keyboard: Keyboard,
        jobs: JobControl,  # knows when the process had been stopped
        interruption: Interruption,  # knows when it is to end
        on_progress: Callable[[Played], None],  # called a few times a second
        on_note: Callable[[str], None],
    ) -> None:
        super().__init__("player")
        self._bag, self._options, self._keyboard, self._jobs = bag, options, keyboard, jobs
        self._interruption, self._on_progress, self._on_note = interruption, on_progress, on_note
        self._first = bag.start + round(options.start_offset * SECOND)
        self._last = bag.end
        if options.duration is not None:
            self._last = min(self._last, self._first + round(options.duration * SECOND))
        if self._first > bag.end:
            length = (bag.end - bag.start) / SECOND
            raise InputError(f"--start-offset: {options.start_offset:g} s: the bag is only {length:g} s long")
        chosen = select_topics(bag.topics, options.topics, options.exclude)
        if options.clock is not None and CLOCK.name in chosen:
            chosen.remove(CLOCK.name)
            if not chosen:
                raise InputError(
                    f"--clock: publishes {CLOCK.name} itself, and nothing else is chosen: leave it out to play "
                    f"{CLOCK.name} as it was recorded, or choose more with --topics"
                )
            on_note(f"{CLOCK.name} of the bag is not played: --clock publishes its own")
        names = parse_remaps(options.remaps, chosen)
        topics = [bag.topics[name] for name in chosen]
        types = message_classes(topics, names, all_wanted=bool(options.topics), on_note=on_note)
        self._latched = {name for name in types if bag.topics[name].latched}
        self._writers: dict[str, Publisher] = {}
        for name, kind in types.items():
            qos = ros_profile(LATCHED if name in self._latched else STREAM)
            self._writers[name] = self.create_publisher(kind, names[name], qos)
        self._check_definitions()
        self._ticker = self.publisher_of(CLOCK) if options.clock else None
        self._time = BagClock(self._first, options.rate, paused=options.paused)
        self._sought = self._first  # messages of topics that are not latched are left out before this time [ns]
        self._steps = 0  # messages to be played one by one
        self._began = self._shown = self._looked = self._ticked = 0.0
        self._awake = time.monotonic()  # when it was last known not to be stopped
        self.played = Played(length=(bag.end - bag.start) / SECOND)

    def _check_definitions(self) -> None:
        """InputError if a topic was recorded with another definition of its type: its bytes mean something else."""
        for name, publisher in self._writers.items():
            topic, infos = self._bag.topics[name], self.get_publishers_info_by_topic(publisher.topic_name)
            ours = {str(info.topic_type_hash) for info in infos if info.node_name == self.get_name()}
            if topic.type_hash and ours and topic.type_hash not in ours:
                raise InputError(
                    f"topic {name}: was recorded with another definition of {topic.type_name} ({topic.type_hash}) than "
                    f"the installed one ({ours.pop()}): install that version, or leave the topic out with --exclude"
                )

    def play(self) -> None:
        """Play the bag, once or (``loop``) until a signal ends it; InputError: required readers are missing."""
        early = self._publish_early()
        self._on_progress(self.played)
        self._wait_for_readers()
        self.played.begun = True
        self._jobs.continued()
        self._time.jump(self._first)
        self._began = self._awake = time.monotonic()
        self._play_once(early)
        while self._options.loop:
            self._sought = self._first
            self._time.jump(self._first)
            self._play_once(0)
        self._wait_for_acknowledgements()

    def _check_signals(self) -> None:
        """End or stop the process if a signal has asked for it."""
        self._interruption.check()
        self._jobs.check()

    def _wait_for_readers(self) -> None:
        """Wait for the required readers, and in any case until no more readers are being discovered."""
        looked, timeout = time.monotonic(), self._options.wait_timeout
        waited = changed = 0.0
        counts: list[int] = []
        noted = False
        while True:
            now = time.monotonic()
            waited, looked = waited + min(now - looked, LONGEST_POLL), now
            missing = self._missing_readers()
            before, counts = counts, [each.get_subscription_count() for each in self._writers.values()]
            if counts != before:
                changed = waited
            if not missing and (waited > changed + SETTLED or waited > SETTLE_LIMIT):
                break
            if missing and waited > timeout:
                raise InputError(f"after {timeout:g} s {'; '.join(missing)}. Are they running {discovery_scope()}?")
            if missing and not noted and waited > NOTE_DELAY:
                noted = True
                self._on_note(f"waiting for readers, {timeout:g} s at most: {'; '.join(missing)}")
            self._check_signals()
            self._press(self._keyboard.wait(DISCOVERY_POLL), self._first)
            self._on_progress(self.played)
        topics = [each.topic_name for each in self._writers.values()]
        if others := [topic for topic in topics if self.count_publishers(topic) > 1]:
            self._on_note(f"other nodes publish as well: {', '.join(others)}")

    def _missing_readers(self) -> list[str]:
        """Unmet requirements in words. Latched topics are not waited for, unless all are latched."""
        few, without, least = [], dict[str, list[str]](), self._options.subscribers
        for name in sorted(self._writers.keys() - self._latched or self._writers.keys()):
            writer = self._writers[name]
            count = writer.get_subscription_count()
            if count < least:
                few.append(f"{writer.topic_name} ({count})")
            if self._options.readers:
                infos = self.get_subscriptions_info_by_topic(writer.topic_name)
                here = {info.node_name for info in infos}
                here |= {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
                for reader in self._options.readers:
                    if reader not in here or count < 1:
                        without.setdefault(reader, []).append(writer.topic_name)
        lines = [f"fewer than {least} read {', '.join(few)}"] if few else []
        return lines + [f"{reader} does not read {', '.join(topics)}" for reader, topics in without.items()]

    def _publish_early(self) -> int:
        """Publish what latched topics hold at the start, before anything else; the number of messages."""
        # A reader that needs it to set up its other subscriptions (which run it is, for example) gets it in time.
        count = 0
        if self._latched:
            for message in self._bag.messages(self._latched, self._first):
                self._check_signals()
                self._send(message)
                count += 1
        self.played.messages += count
        return count

    def _play_once(self, early: int) -> None:
        """Play the bag without its first ``early`` messages of latched topics, which have been published."""
        for message in self._bag.messages(self._writers.keys(), self._last):
            self._check_signals()
            latched = message.topic in self._latched
            if latched and early:
                early -= 1
                continue
            if message.time < self._sought and not latched:
                continue
            self._wait_for(message)
            if message.time < self._sought and not latched:  # a key meanwhile
                continue
            before = time.monotonic()
            self._send(message)
            took = time.monotonic() - before
            if took > BLOCKED_AFTER:
                self._time.hold(took)
                self._jobs.continued()  # a stop in that time is not counted again
                self.played.held_back += took
                self._awake = before + took
            self.played.messages += 1

    def _send(self, message: Message) -> None:
        """Publish a message, again while readers block; one that is refused without waiting never goes through."""
        writer = self._writers[message.topic]
        while True:
            before = time.monotonic()
            try:
                writer.handle.publish_raw(message.data)
                return
            except RCLError as error:
                if time.monotonic() - before < FINAL_BEFORE:
                    kind = self._bag.topics[message.topic].type_name
                    raise InputError(
                        f"topic {message.topic}: {len(message.data)} bytes: not a valid {kind} message "
                        f"({error}): leave the topic out with --exclude"
                    ) from error
            self._check_signals()

    def _wait_for(self, message: Message) -> None:
        """Wait until a message is due; handle signals, keyboard, ``/clock`` and progress meanwhile."""
        while message.time >= self._sought:
            now = time.monotonic()
            wait = self._time.until(message.time)
            if wait <= 0 and now < self._looked + CHECK_PERIOD and (self._ticker is None or now < self._next_tick()):
                return
            self._update(now, message.time)
            wait = self._time.until(message.time)
            if wait <= 0:
                return
            if self._steps:
                self._steps -= 1
                self._time.jump(message.time)
                return
            next_tick = math.inf if self._ticker is None else self._next_tick() - now
            self._press(self._keyboard.wait(min(wait, CHECK_PERIOD, next_tick)), message.time)
            self._check_signals()

    def _update(self, now: float, next_time: int) -> None:
        # The time of a stop does not count. We may notice it late: any thread of the process may get the signal.
        if self._jobs.continued() or now - self._awake > STOPPED_AFTER:
            now = time.monotonic()
            self._time.hold(now - self._awake)
        self._looked = self._awake = now
        self._press(self._keyboard.wait(0.0), next_time)
        here = self._time.now(next_time)
        if self._ticker is not None and now >= self._next_tick():
            self._ticked = now
            seconds, nanoseconds = divmod(here, SECOND)
            self._ticker.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
        if now >= self._shown + PROGRESS_PERIOD:
            self._shown = now
            self._report(here)

    def _next_tick(self) -> float:
        """Monotonic time [s] at which ``/clock`` is published next."""
        return self._ticked + 1.0 / (self._options.clock or math.inf)

    def _press(self, keys: Iterable[str], next_time: int) -> None:
        for key in keys:
            if key == "space":
                self._time.pause(not self._time.paused, next_time)
            elif key == "enter" and self.played.typed:
                self._go_to(self.played.typed, next_time)
            elif key in ("step", "enter"):
                self._time.pause(True, next_time)
                self._steps += 1
            elif key == "forward":
                self._seek(self._here(next_time) + round(SEEK_SHARE * (self._last - self._first)))
            elif key in ("up", "down"):
                self._time.change_rate(RATE_STEP if key == "up" else 1 / RATE_STEP, next_time)
            else:  # of a time
                typed = self.played.typed
                self.played.typed = typed[:-1] if key == "back" else (typed + key)[:MOST_TYPED]

    def _here(self, next_time: int) -> int:
        return max(self._time.now(next_time), self._sought)

    def _go_to(self, typed: str, next_time: int) -> None:
        """Go forward to a time that was typed [s from the start of the bag]; there is no way back."""
        self.played.typed = ""
        here, end = ((each - self._bag.start) / SECOND for each in (self._here(next_time), self._last))
        try:
            wanted = float(typed)
        except ValueError:
            self._on_note(f"{typed}: expected a time in seconds, such as 12.5")
            return
        if wanted > end:
            self._on_note(f"{typed} s: expected a time up to {end:g} s, where the bag ends")
        elif wanted < here:
            self._on_note(f"{typed} s: there is no way back from {here:g} s: start again with --start-offset {typed}")
        else:
            self._seek(self._bag.start + round(wanted * SECOND))

    def _seek(self, when: int) -> None:
        """Go forward to a time of the bag [ns]. Latched messages on the way are all published, at once."""
        if self.played.begun:
            self._sought = min(when, self._last)
            self._time.jump(self._sought)

    def _report(self, here: int) -> None:
        played = self.played
        played.seconds = time.monotonic() - self._began
        played.now = (here - self._bag.start) / SECOND
        played.rate, played.paused = self._time.rate, self._time.paused
        self._on_progress(played)

    def _wait_for_acknowledgements(self) -> None:
        """Wait until all readers have acknowledged everything: the rest would be lost with this process."""
        self._report(self._last)
        waiting = list(self._writers.values())
        began, noted = time.monotonic(), False
        while waiting:
            self._check_signals()
            each_waits = Duration(seconds=ACK_SLICE / len(waiting))
            waiting = [writer for writer in waiting if not writer.wait_for_all_acked(each_waits)]
            if waiting and not noted and time.monotonic() > began + ACK_NOTE_DELAY:
                noted = True
                names = ", ".join(writer.topic_name for writer in waiting)
                self._on_note(f"waiting until the readers of {names} have received everything")


def play(
    path: Path,
    options: PlayOptions,
    *,
    on_progress: Callable[[Played], None],
    on_note: Callable[[str], None],
    on_stop: Callable[[], None],  # before Ctrl-Z stops the process
    on_continue: Callable[[], None],  # when it goes on
) -> Played:
    """Play a bag (or one of its files) in this process; BagError, InputError: not a bag, or not playable like that."""
    # Ctrl-C raises KeyboardInterrupt, another signal SystemExit: only ``on_progress`` then has said how far it came.
    bag = Playback(path)
    said = bag.damage
    for line in said:
        on_note(line)
    with ros_arguments():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Player] = []
    complete = False
    try:
        with Keyboard() as keyboard, Interruption() as interruption:

            def before() -> None:
                on_stop()
                keyboard.let_go()

            def after() -> None:
                keyboard.listen()
                on_continue()

            with JobControl(before=before, after=after) as jobs:
                nodes = [Player(bag, options, keyboard, jobs, interruption, on_progress, on_note)]
                nodes[0].play()
                complete = True
    finally:
        for line in bag.damage:
            if line not in said:
                on_note(line)
        leave(nodes, None, complete=complete)
    return nodes[0].played
