# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The network's messages as CDR bytes, without ROS; the encoding is described in :mod:`msg_analysis.messages.cdr`.

The message classes read and write every valid message. :class:`StateCodec` and :class:`StateFrame` are faster and
handle only the layout that the agents send: little-endian, empty ``frame_id``. :class:`MessageType` describes a type as
rosbag2 does.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.common.arrays import AnyArray, FloatArray
from msg_analysis.messages.cdr import HEADER_SIZE, LITTLE_ENDIAN, RUN_SIZE, CdrError, CdrReader, CdrWriter

_STAMP = {b"\x00\x01": struct.Struct("<4xiI"), b"\x00\x00": struct.Struct(">4xiI")}
# Encapsulation, sec, nanosec, frame_id (length 1, NUL), run, agent, step, mode, len(heard), len(state).
_STATE = struct.Struct("<4siIIB16s3xI4xQIII4x")
STATE_SIZE = _STATE.size  # bytes of a message without the entries of ``heard`` and ``state``
# The same bytes up to the length of ``heard``, for many messages at once; the gaps between the offsets are padding.
STATE_HEAD = np.dtype(
    {
        "names": [
            *("encapsulation", "seconds", "nanoseconds", "frame_size", "frame_end", "run"),
            *("agent", "step", "mode", "heard_count"),
        ],
        "formats": ["<u4", "<i4", "<u4", "<u4", "u1", ("<u8", (2,)), "<u4", "<u8", "<u4", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 17, 36, 44, 52, 56],
        "itemsize": 60,
    }
)
# The same bytes for reading: the stamp is skipped, frame_id and run are one field.
_STATE_FIXED = struct.Struct("<4s8x21s3xI4xQIII4x")
# The entries of ``heard`` (uint64) lie between its length and that of the state, without padding.
_HEARD = struct.Struct("<I")
_HEARD_START = STATE_HEAD.itemsize
_LENGTH = struct.Struct("<I4x")  # of the state, with the padding before it
STATE_MODE = _STATE.size - 16  # byte offset of ``mode`` in a state message


def stamp_ns(data: bytes) -> int:
    """Time stamp [ns] of a message that begins with a std_msgs/Header, of either byte order; CdrError: it has none."""
    try:
        seconds, nanoseconds = _STAMP[data[:2]].unpack_from(data)
    except (KeyError, struct.error) as error:
        raise CdrError(f"stamp: no CDR header and stamp in {bytes(data[:12]).hex(' ') or 'no bytes'}") from error
    return int(seconds) * SECOND + int(nanoseconds)


class StateCodec:
    """Writes the states (``replicas`` float64) of one agent (from 1); ``run``: 16 bytes, ``dt`` in simulated time."""

    def __init__(self, run: bytes, agent: int, replicas: int, dt: float) -> None:
        if len(run) != RUN_SIZE:
            raise ValueError(f"run: {len(run)} bytes, expected the {RUN_SIZE} bytes of a UUID")
        self._run, self._agent, self._replicas = bytes(run), agent, replicas
        self._nanoseconds = StepClock(dt).nanoseconds

    def wrap(self, step: int, mode: int, payload: bytes, heard: Sequence[int] = (), stamp: int | None = None) -> bytes:
        """AgentState of x(k), 8 bytes for each replica; ``heard``: empty: all of k - 1; ``stamp`` [ns]: None: k dt."""
        seconds, nanoseconds = divmod(self._nanoseconds(step) if stamp is None else stamp, SECOND)
        fixed = (1, 0, self._run, self._agent, step, mode, len(heard), self._replicas)
        data = _STATE.pack(LITTLE_ENDIAN, seconds, nanoseconds, *fixed)
        if heard:
            steps = struct.pack(f"<{len(heard)}Q", *heard)
            data = data[:_HEARD_START] + steps + data[_HEARD_START:]
        return data + payload


class StateFrame:
    """Reads states of one run (16 bytes of its id) in the layout that :class:`StateCodec` writes."""

    def __init__(self, run: bytes, replicas: int, most_heard: int = 0) -> None:
        self._fixed = b"\x01\x00\x00\x00\x00" + bytes(run)
        self.replicas, self.most_heard = replicas, most_heard
        self._least = _STATE.size + 8 * replicas
        self.size = self._least + 8 * most_heard  # bytes of the longest message

    def unwrap(self, data: bytes) -> tuple[int, int, int, bytes] | None:
        """(agent, step, mode, state as a payload), or None where the bytes are not of this run and layout."""
        if len(data) != self._least:
            return self._unwrap_heard(data)
        header, fixed, agent, step, mode, heard, replicas = _STATE_FIXED.unpack_from(data)
        if fixed != self._fixed or heard or replicas != self.replicas or header != LITTLE_ENDIAN:
            return None
        return agent, step, mode, data[_STATE.size :]

    def _unwrap_heard(self, data: bytes) -> tuple[int, int, int, bytes] | None:
        """The same of a message with a non-empty ``heard``: without those entries it has the fixed length."""
        if not self._least < len(data) <= self.size:
            return None
        length = len(data) - self._least
        if _HEARD.unpack_from(data, _HEARD_START - _HEARD.size)[0] * 8 != length:
            return None
        empty = data[: _HEARD_START - _HEARD.size] + bytes(_HEARD.size)
        return self.unwrap(empty + data[_HEARD_START + length :])


def with_state(data: bytes, payload: bytes, size: int | None = None) -> bytes:
    """A message of :class:`StateCodec` with another state; ``size``: bytes of the old one, None: as many as the new."""
    if size is None or size == len(payload):
        return data[: len(data) - len(payload)] + payload
    return data[: len(data) - size - _LENGTH.size] + _LENGTH.pack(len(payload) // 8) + payload


@dataclass(frozen=True, slots=True, eq=False)
class AgentState:
    """msg_agents_interfaces/msg/AgentState: the state x(k) of one agent.

    Attributes
    ----------
    stamp
        simulated time of the step, k dt [ns]; in real time, that at which the state was made
    run
        the 16 bytes of the run id
    agent
        number of the agent, from 1
    step
        k
    mode
        graph of the step that led to this state, from 1; 0 at step 0
    state
        (replicas,) float64; of a protocol, its state row by row
    heard
        (neighbours,) uint64, steps of the values used, neighbours ascending; 2^64 - 1: none was received; empty: all
        are of step k - 1
    frame_id
        of the header; empty in messages of the agents
    """

    stamp: int
    run: bytes
    agent: int
    step: int
    mode: int
    state: FloatArray
    heard: AnyArray = field(default_factory=lambda: np.empty(0, np.uint64))
    frame_id: str = ""

    def encode(self) -> bytes:
        """The message as little-endian CDR, with its 4-byte encapsulation header.

        Raises
        ------
        ValueError
            ``run`` is not 16 bytes
        struct.error
            a number does not fit into its field
        """
        out = CdrWriter()
        out.header(self.stamp, self.frame_id, self.run)
        out.number("I", self.agent)
        out.number("Q", self.step)
        out.number("I", self.mode)
        out.array("u8", self.heard)
        out.array("f8", self.state)
        return out.bytes()

    @classmethod
    def decode(cls, data: bytes) -> AgentState:
        """Decode a message from CDR of either byte order.

        Parameters
        ----------
        data
            the message with its 4-byte encapsulation header

        Returns
        -------
        AgentState
            with arrays of its own

        Raises
        ------
        CdrError
            the bytes are not an AgentState; the text names the field
        """
        reader = CdrReader(data, "AgentState")
        stamp, frame_id, run = reader.header()
        agent, step, mode = reader.number("I", "agent"), reader.number("Q", "step"), reader.number("I", "mode")
        heard, state = reader.array("u8", "heard"), reader.array("f8", "state")
        reader.end()
        return cls(stamp, run, agent, step, mode, state, heard, frame_id)


@dataclass(frozen=True, slots=True, eq=False)
class ActiveGraph:
    """msg_agents_interfaces/msg/ActiveGraph: one holding period of the switching graph."""

    stamp: int  # simulated time at which it begins [ns]
    run: bytes  # 16 bytes
    sequence: int  # number of the holding period, from 0
    mode: int  # from 1
    name: str
    first_step: int  # the steps k -> k+1 with first_step <= k <= last_step use this graph
    last_step: int
    arcs: Sequence[tuple[int, int, float]] = ()  # (source, target, weight), from 1: target listens to source
    frame_id: str = ""

    def encode(self) -> bytes:
        """As little-endian CDR."""
        out = CdrWriter()
        out.header(self.stamp, self.frame_id, self.run)
        out.number("I", self.sequence)
        out.number("I", self.mode)
        out.string(self.name)
        out.number("Q", self.first_step)
        out.number("Q", self.last_step)
        out.array("u4", [source for source, _, _ in self.arcs])
        out.array("u4", [target for _, target, _ in self.arcs])
        out.array("f8", [weight for _, _, weight in self.arcs])
        return out.bytes()

    @classmethod
    def decode(cls, data: bytes) -> ActiveGraph:
        """From CDR; CdrError where it is not an ActiveGraph, or its three lists of arcs differ in length."""
        reader = CdrReader(data, "ActiveGraph")
        stamp, frame_id, run = reader.header()
        sequence, mode, name = reader.number("I", "sequence"), reader.number("I", "mode"), reader.string("name")
        first, last = reader.number("Q", "first_step"), reader.number("Q", "last_step")
        arcs, rest = None, reader.rest()
        if len(rest) <= _MAX_KNOWN:
            with contextlib.suppress(CdrError):  # `_read_arcs` below raises it with the right places
                arcs = _known_arcs(data[:HEADER_SIZE] + bytes(8) + rest)
        if arcs is None:
            arcs = _read_arcs(reader)
        return cls(stamp, run, sequence, mode, name, first, last, arcs, frame_id)


_MAX_KNOWN = 2**18  # bytes of the arcs of one graph that are cached


def _read_arcs(reader: CdrReader) -> tuple[tuple[int, int, float], ...]:
    source, target = reader.array("u4", "source"), reader.array("u4", "target")
    weight = reader.array("f8", "weight")
    reader.end()
    if not len(source) == len(target) == len(weight):
        raise CdrError(f"ActiveGraph: {len(source)} sources, {len(target)} targets and {len(weight)} weights")
    return tuple(zip(source.tolist(), target.tolist(), weight.tolist(), strict=True))


@lru_cache(maxsize=32)
def _known_arcs(data: bytes) -> tuple[tuple[int, int, float], ...]:
    """Arcs from the bytes behind ``last_step``, cached: the same few graphs come again and again."""
    reader = CdrReader(data, "ActiveGraph")
    reader.number("Q", "last_step")
    return _read_arcs(reader)


@dataclass(frozen=True, slots=True)
class Progress:
    """msg_agents_interfaces/msg/Progress: how far an agent, the recorder or the switcher is."""

    stamp: int  # simulated time of the step; on the topic `epoch`, node clock at simulated time 0 [ns]
    run: bytes  # 16 bytes
    agent: int  # from 1; 0: the recorder or the switcher
    step: int  # newest one that it has published; from the recorder and the switcher, the last of the run
    frame_id: str = ""

    def encode(self) -> bytes:
        """As little-endian CDR."""
        out = CdrWriter()
        out.header(self.stamp, self.frame_id, self.run)
        out.number("I", self.agent)
        out.number("Q", self.step)
        return out.bytes()

    @classmethod
    def decode(cls, data: bytes) -> Progress:
        """From CDR; CdrError where it is not a Progress."""
        reader = CdrReader(data, "Progress")
        stamp, frame_id, run = reader.header()
        agent, step = reader.number("I", "agent"), reader.number("Q", "step")
        reader.end()
        return cls(stamp, run, agent, step, frame_id)


def encode_string(text: str) -> bytes:
    """A std_msgs/String as CDR."""
    out = CdrWriter()
    out.string(text)
    return out.bytes()


def decode_string(data: bytes) -> str:
    """Text of a std_msgs/String; CdrError where the bytes are not one."""
    reader = CdrReader(data, "String")
    text = reader.string("data")
    reader.end()
    return text


_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
_FIELD_OF_OTHER_PACKAGE = re.compile(r"^([a-z][a-z0-9_]*)/(?:msg/)?([A-Z]\w*)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type; its hash is the RIHS01 hash of REP-2016, in rosidl's ``share/<package>/msg/<name>.json``."""

    package: str
    name: str
    type_hash: str = ""  # empty: never recorded

    @property
    def full_name(self) -> str:
        """``package/msg/Name``."""
        return f"{self.package}/msg/{self.name}"

    @property
    def schema(self) -> str:
        """Its .msg text, followed by those of all types that it is made of."""
        text = _definition(self.package, self.name)
        pending, seen = _FIELD_OF_OTHER_PACKAGE.findall(text), {(self.package, self.name)}
        while pending:
            package, name = pending.pop(0)
            if (package, name) not in seen:
                seen.add((package, name))
                definition = _definition(package, name)
                text += f"{_SEPARATOR}{package}/{name}\n{definition}"
                pending += _FIELD_OF_OTHER_PACKAGE.findall(definition)
        return text


def _definition(package: str, name: str) -> str:
    file = resources.files("msg_analysis.messages") / "definitions" / package / "msg" / f"{name}.msg"
    return file.read_text(encoding="utf-8")


_INTERFACES = "msg_agents_interfaces"
AGENT_STATE = MessageType(
    _INTERFACES, "AgentState", "RIHS01_855e25ca7b9bb12acd4cc3177f2571fd1fd2a525ed333a403d6296120e29a9e6"
)
ACTIVE_GRAPH = MessageType(
    _INTERFACES, "ActiveGraph", "RIHS01_494043cce7f43cfa3b137d0b7770f26bb0802ec0032a6ecf7b44f6dbfc422c82"
)
PROGRESS = MessageType(
    _INTERFACES, "Progress", "RIHS01_075d0eb0154f1de34225d33cb0aa303f408a92a2011e46c0487e20ae63394fe6"
)
ESTIMATE = MessageType(
    _INTERFACES, "Estimate", "RIHS01_115be21e1cecad98ff8eecdcae1ab03d2a324db256d5b58f8060f94cb918c9df"
)
STATE_BATCH = MessageType(_INTERFACES, "StateBatch")
STRING = MessageType("std_msgs", "String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
