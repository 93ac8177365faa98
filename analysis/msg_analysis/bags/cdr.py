"""The network's messages as CDR bytes, without ROS (OMG CDR, or XCDR1, as ROS 2 middleware sends it).

Layout: a 4-byte encapsulation header (00 01: little-endian, 00 00: big-endian, two bytes of options), then
the fields in order, each primitive aligned to its own size, counted from the end of the header. A string is
its length with the closing NUL (uint32), its UTF-8 bytes and the NUL; a sequence is its length (uint32) and
its elements.

Two ways in: the message classes read and write anything that is valid; :class:`StateCodec` and
:class:`StateFrame` do the one layout that the agents themselves send (empty ``frame_id``), which without
``heard`` has a fixed length, in half a microsecond.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np

from msg_analysis.model.payload import to_payload
from msg_analysis.types import AnyArray, FloatArray

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
HEADER_SIZE = 4
RUN_SIZE = 16
SECOND = 1_000_000_000  # ns
# Bytes that may follow a message: Fast DDS aligns the end as if elements followed an empty sequence of 8-byte
# numbers, and fills up to a multiple of four.
_MAX_PADDING = 7

_STAMP = {b"\x00\x01": struct.Struct("<4xiI"), b"\x00\x00": struct.Struct(">4xiI")}
# Encapsulation, sec, nanosec, frame_id (1, NUL), run, agent, step, mode, len(heard) (0), len(state).
_STATE = struct.Struct("<4siIIB16s3xI4xQIII4x")
# The same bytes for reading: without the stamp, frame_id and run in one piece.
_STATE_FIXED = struct.Struct("<4s8x21s3xI4xQIII4x")
# The steps in ``heard`` stand between its length and that of the state, eight bytes each, without any padding.
_HEARD = struct.Struct("<I")
_HEARD_START = _STATE.size - 8
_LENGTH = struct.Struct("<I4x")  # of the state, before it


class CdrError(ValueError):
    """Bytes that are not the expected message. The text names the field and what is wrong with it."""


class StepClock:
    """Simulated time of the steps in whole nanoseconds, free of rounding drift.

    Parameters
    ----------
    dt : length of a step [units of simulated time, written as seconds]; its decimal text counts: 0.1 is one
        tenth
    """

    def __init__(self, dt: float) -> None:
        step = Fraction(repr(float(dt))) * SECOND
        self._numerator, self._denominator = step.numerator, step.denominator

    def nanoseconds(self, step: int) -> int:
        """Time k dt of step k, rounded to the nearest nanosecond (a half goes up)."""
        if self._denominator == 1:
            return step * self._numerator
        return (2 * step * self._numerator + self._denominator) // (2 * self._denominator)


def stamp_ns(data: bytes) -> int:
    """Time stamp [ns] of any message that begins with a std_msgs/Header.

    Raises
    ------
    CdrError : too short, or of an unknown encapsulation
    """
    try:
        seconds, nanoseconds = _STAMP[data[:2]].unpack_from(data)
    except (KeyError, struct.error) as error:
        raise CdrError(f"stamp: no CDR header and stamp in {bytes(data[:12]).hex(' ') or 'no bytes'}") from error
    return int(seconds) * SECOND + int(nanoseconds)


class StateCodec:
    """Writes the states of one agent.

    Parameters
    ----------
    run : the 16 bytes of the run id
    agent : number of the agent, from 1
    replicas : length of every state
    dt : length of a step [units of simulated time]
    """

    def __init__(self, run: bytes, agent: int, replicas: int, dt: float) -> None:
        if len(run) != RUN_SIZE:
            raise ValueError(f"run: {len(run)} bytes, expected the {RUN_SIZE} bytes of a UUID")
        self._run, self._agent, self._replicas = bytes(run), agent, replicas
        self._nanoseconds = StepClock(dt).nanoseconds
        self._shape = (replicas,)

    def encode(self, step: int, mode: int, state: FloatArray) -> bytes:
        """One AgentState.

        Parameters
        ----------
        step, mode, state : int, int, FloatArray
            k; graph of the step that led here, from 1 (0 at step 0); (replicas,) x(k), float64

        Raises
        ------
        ValueError : state of another shape or type (its bytes would be a different message)
        """
        if state.shape != self._shape or state.dtype != np.float64:
            raise ValueError(f"state: {state.dtype} of shape {state.shape}, expected float64 of shape {self._shape}")
        return self.wrap(step, mode, to_payload(state))

    def wrap(self, step: int, mode: int, payload: bytes, heard: Sequence[int] = (), stamp: int | None = None) -> bytes:
        """One AgentState of a state that is bytes already, of the right length; by default stamped k dt [ns]."""
        seconds, nanoseconds = divmod(self._nanoseconds(step) if stamp is None else stamp, SECOND)
        fixed = (1, 0, self._run, self._agent, step, mode, len(heard), self._replicas)
        data = _STATE.pack(LITTLE_ENDIAN, seconds, nanoseconds, *fixed)
        if heard:
            steps = struct.pack(f"<{len(heard)}Q", *heard)
            data = data[:_HEARD_START] + steps + data[_HEARD_START:]
        return data + payload


class StateFrame:
    """Reads states in the layout that :class:`StateCodec` writes, of one run.

    Parameters
    ----------
    run : the 16 bytes of the run id
    replicas : length of every state
    most_heard : largest length of ``heard``

    Attributes
    ----------
    replicas : as given
    size : bytes of the longest message
    """

    def __init__(self, run: bytes, replicas: int, most_heard: int = 0) -> None:
        self._fixed = b"\x01\x00\x00\x00\x00" + bytes(run)
        self.replicas = replicas
        self._least = _STATE.size + 8 * replicas
        self.size = self._least + 8 * most_heard

    def unwrap(self, data: bytes) -> tuple[int, int, int, bytes] | None:
        """(agent, step, mode, state as a payload), or None where the bytes are not of this run and layout.

        None means: ask :meth:`AgentState.decode`, which tells what it is.
        """
        if len(data) != self._least:
            return self._unwrap_heard(data)
        header, fixed, agent, step, mode, heard, replicas = _STATE_FIXED.unpack_from(data)
        if fixed != self._fixed or heard or replicas != self.replicas or header != LITTLE_ENDIAN:
            return None
        return agent, step, mode, data[_STATE.size :]

    def _unwrap_heard(self, data: bytes) -> tuple[int, int, int, bytes] | None:
        """The same of a message whose ``heard`` is not empty: take that out, and it is one of fixed length."""
        if not self._least < len(data) <= self.size:
            return None
        length = len(data) - self._least
        if _HEARD.unpack_from(data, _HEARD_START - _HEARD.size)[0] * 8 != length:
            return None
        empty = data[: _HEARD_START - _HEARD.size] + bytes(_HEARD.size)
        return self.unwrap(empty + data[_HEARD_START + length :])


def with_state(data: bytes, payload: bytes, size: int | None = None) -> bytes:
    """The same AgentState, as :class:`StateCodec` writes it, with another state.

    Parameters
    ----------
    data, payload : the message, and the bytes of the new state
    size : bytes of the old state; as many as those of the new one if not given
    """
    if size is None or size == len(payload):
        return data[: len(data) - len(payload)] + payload
    return data[: len(data) - size - _LENGTH.size] + _LENGTH.pack(len(payload) // 8) + payload


_NUMBERS = {order: {code: struct.Struct(order + code) for code in "iIQ"} for order in "<>"}


class _Reader:
    """Takes fields off CDR bytes; checks every length before it makes anything of it."""

    def __init__(self, data: bytes, kind: str) -> None:
        self._kind = kind
        if len(data) < HEADER_SIZE or data[0] != 0 or data[1] > 1:
            start = bytes(data[:HEADER_SIZE]).hex(" ") or "nothing"
            raise CdrError(f"{kind}: begins with {start}, expected a CDR header 00 01 00 00")
        self._data, self._order = data, "<" if data[1] else ">"
        self._numbers = _NUMBERS[self._order]
        self._at = HEADER_SIZE

    def _take(self, size: int, alignment: int, what: str) -> int:
        start = self._at + (HEADER_SIZE - self._at) % alignment
        if start + size > len(self._data):
            raise CdrError(f"{self._kind}.{what}: needs {start + size} bytes, the message has {len(self._data)}")
        self._at = start + size
        return start

    def number(self, code: str, what: str) -> int:
        form = self._numbers[code]
        size = form.size
        value: int = form.unpack_from(self._data, self._take(size, size, what))[0]
        return value

    def raw(self, size: int, what: str) -> bytes:
        start = self._take(size, 1, what)
        return bytes(self._data[start : self._at])

    def string(self, what: str) -> str:
        size = self.number("I", what)
        text = self.raw(size, what)
        if size and text[-1]:
            raise CdrError(f"{self._kind}.{what}: a string without its closing NUL")
        try:
            return text[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"{self._kind}.{what}: not UTF-8") from error

    def array(self, code: str, what: str) -> AnyArray:
        count = self.number("I", what)
        if not count:  # nothing follows, not even padding
            return np.empty(0, dtype=code)
        size = np.dtype(code).itemsize
        start = self._take(count * size, size, what)
        return np.frombuffer(self._data, self._order + code, count, start).astype(code)

    def stamp(self) -> int:
        return self.number("i", "header") * SECOND + self.number("I", "header")

    def rest(self) -> bytes:
        """What has not been read."""
        return self._data[self._at :]

    def end(self) -> None:
        left = len(self._data) - self._at
        if left > _MAX_PADDING:
            raise CdrError(f"{self._kind}: {left} bytes too many")


class _Writer:
    """Appends fields to little-endian CDR bytes."""

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN)

    def _align(self, size: int) -> None:
        self._data += bytes((HEADER_SIZE - len(self._data)) % size)

    def number(self, code: str, value: int) -> None:
        self._align(struct.calcsize(code))
        self._data += struct.pack("<" + code, value)

    def raw(self, value: bytes) -> None:
        self._data += value

    def string(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.number("I", len(encoded))
        self._data += encoded

    def array(self, code: str, values: AnyArray | Sequence[Any]) -> None:
        array = np.asarray(values, dtype="<" + code)
        self.number("I", len(array))
        if len(array):
            self._align(array.itemsize)
            self._data += array.tobytes()

    def header(self, stamp: int, frame_id: str, run: bytes) -> None:
        if len(run) != RUN_SIZE:
            raise ValueError(f"run: {len(run)} bytes, expected the {RUN_SIZE} bytes of a UUID")
        self.number("i", stamp // SECOND)
        self.number("I", stamp % SECOND)
        self.string(frame_id)
        self.raw(run)

    def bytes(self) -> bytes:
        return bytes(self._data)


@dataclass(frozen=True, slots=True, eq=False)
class AgentState:
    """msg_agents_interfaces/msg/AgentState: x(k) of one agent.

    Attributes
    ----------
    stamp : simulated time of the step [ns]
    run : 16 bytes
    agent : from 1
    step : k
    mode : from 1; 0 at step 0
    state : (replicas,)
    heard : (neighbours,) steps of the values used; empty: all of k - 1
    frame_id : of the header
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
        """As CDR."""
        out = _Writer()
        out.header(self.stamp, self.frame_id, self.run)
        out.number("I", self.agent)
        out.number("Q", self.step)
        out.number("I", self.mode)
        out.array("u8", self.heard)
        out.array("f8", self.state)
        return out.bytes()

    @classmethod
    def decode(cls, data: bytes) -> AgentState:
        """From CDR; raises CdrError."""
        reader = _Reader(data, "AgentState")
        stamp, frame_id = reader.stamp(), reader.string("header.frame_id")
        run, agent = reader.raw(RUN_SIZE, "run"), reader.number("I", "agent")
        step, mode = reader.number("Q", "step"), reader.number("I", "mode")
        heard, state = reader.array("u8", "heard"), reader.array("f8", "state")
        reader.end()
        return cls(stamp, run, agent, step, mode, state, heard, frame_id)


@dataclass(frozen=True, slots=True, eq=False)
class ActiveGraph:
    """msg_agents_interfaces/msg/ActiveGraph: one sojourn of the switching graph.

    Attributes
    ----------
    stamp : simulated time at which it begins [ns]
    run : 16 bytes
    sequence : number of the sojourn, from 0
    mode : from 1
    name : of the graph
    first_step, last_step : the steps k -> k+1 with first_step <= k <= last_step use it
    arcs : (source, target, weight), agents from 1: target listens to source
    frame_id : of the header
    """

    stamp: int
    run: bytes
    sequence: int
    mode: int
    name: str
    first_step: int
    last_step: int
    arcs: Sequence[tuple[int, int, float]] = ()
    frame_id: str = ""

    def encode(self) -> bytes:
        """As CDR."""
        out = _Writer()
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
        """From CDR; raises CdrError, also where the three lists of the arcs are not equally long."""
        reader = _Reader(data, "ActiveGraph")
        stamp, frame_id = reader.stamp(), reader.string("header.frame_id")
        run, sequence = reader.raw(RUN_SIZE, "run"), reader.number("I", "sequence")
        mode, name = reader.number("I", "mode"), reader.string("name")
        first, last = reader.number("Q", "first_step"), reader.number("Q", "last_step")
        arcs, rest = None, reader.rest()
        if len(rest) <= _MAX_KNOWN:
            with contextlib.suppress(CdrError):  # which would count bytes from the wrong beginning
                arcs = _known_arcs(data[:HEADER_SIZE] + bytes(8) + rest)
        if arcs is None:
            arcs = _read_arcs(reader)
        return cls(stamp, run, sequence, mode, name, first, last, arcs, frame_id)


_MAX_KNOWN = 2**18  # bytes of the arcs of one graph


def _read_arcs(reader: _Reader) -> tuple[tuple[int, int, float], ...]:
    source, target = reader.array("u4", "source"), reader.array("u4", "target")
    weight = reader.array("f8", "weight")
    reader.end()
    if not len(source) == len(target) == len(weight):
        raise CdrError(f"ActiveGraph: {len(source)} sources, {len(target)} targets and {len(weight)} weights")
    return tuple(zip(source.tolist(), target.tolist(), weight.tolist(), strict=True))


@lru_cache(maxsize=32)
def _known_arcs(data: bytes) -> tuple[tuple[int, int, float], ...]:
    """The same graphs come again and again: their arcs, behind ``last_step``, are read and kept in memory once."""
    reader = _Reader(data, "ActiveGraph")
    reader.number("Q", "last_step")
    return _read_arcs(reader)


@dataclass(frozen=True, slots=True)
class Progress:
    """msg_agents_interfaces/msg/Progress: how far one agent is.

    Attributes
    ----------
    stamp : simulated time of the step [ns]
    run : 16 bytes
    agent : from 1
    step : newest step that it has published
    frame_id : of the header
    """

    stamp: int
    run: bytes
    agent: int
    step: int
    frame_id: str = ""

    def encode(self) -> bytes:
        """As CDR."""
        out = _Writer()
        out.header(self.stamp, self.frame_id, self.run)
        out.number("I", self.agent)
        out.number("Q", self.step)
        return out.bytes()

    @classmethod
    def decode(cls, data: bytes) -> Progress:
        """From CDR; raises CdrError."""
        reader = _Reader(data, "Progress")
        stamp, frame_id = reader.stamp(), reader.string("header.frame_id")
        run = reader.raw(RUN_SIZE, "run")
        agent, step = reader.number("I", "agent"), reader.number("Q", "step")
        reader.end()
        return cls(stamp, run, agent, step, frame_id)


def encode_string(text: str) -> bytes:
    """A std_msgs/String as CDR."""
    out = _Writer()
    out.string(text)
    return out.bytes()


def decode_string(data: bytes) -> str:
    """Text of a std_msgs/String; raises CdrError."""
    reader = _Reader(data, "String")
    text = reader.string("data")
    reader.end()
    return text
