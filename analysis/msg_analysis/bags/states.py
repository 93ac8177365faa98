"""State messages as columns: where they have the agents' own layout, a batch is one numpy record array."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from msg_analysis.bags.cdr import LITTLE_ENDIAN, RUN_SIZE, SECOND, AgentState, CdrError
from msg_analysis.bags.mcapfile import Batch
from msg_analysis.types import AnyArray, FloatArray, IntArray

_FIXED_SIZE = 68  # bytes of an AgentState before its state, where frame_id and heard are empty
_HEARD_COUNT = 56  # where the length of heard is


def _layout(replicas: int, heard: int) -> np.dtype[np.void]:
    """Of an AgentState with empty ``frame_id`` and so many steps in ``heard``; its own bytes, padding left out."""
    longer = 8 * heard
    fields = {
        "header": ("V4", 0),
        "seconds": ("<i4", 4),
        "nanoseconds": ("<u4", 8),
        "frame_id": ("V5", 12),
        "run": (f"V{RUN_SIZE}", 17),
        "agent": ("<u4", 36),
        "step": ("<u8", 44),
        "mode": ("<u4", 52),
        "heard_count": ("<u4", _HEARD_COUNT),
        "heard": (("<u8", (heard,)), 60),
        "replicas": ("<u4", 60 + longer),
        "state": (("<f8", (replicas,)), _FIXED_SIZE + longer),
    }
    return np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": _FIXED_SIZE + longer + 8 * replicas,
        }
    )


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States of one run with equally many replicas, in the order of the bag.

    Attributes
    ----------
    position : (messages,) place in the bag
    agent, step, mode : (messages,) as sent: agents and modes from 1; clipped to the range of int64
    state : (messages, replicas)
    heard_count : (messages,) length of ``heard``
    heard : (messages, D) its first D entries; 0 beyond its end
    stamp : (messages,) [ns]
    """

    position: IntArray
    agent: IntArray
    step: IntArray
    mode: IntArray
    state: FloatArray
    heard_count: IntArray
    heard: AnyArray
    stamp: IntArray


@dataclass(slots=True)
class StateColumns:
    """Collects the states of all runs that a bag holds.

    Attributes
    ----------
    undecodable : messages that are no AgentState
    """

    undecodable: int = 0
    _columns: dict[tuple[bytes, int], list[States]] = field(default_factory=dict)
    _position: int = 0

    def add(self, batch: Batch, chosen: IntArray) -> None:
        """Take the states out of a batch.

        Parameters
        ----------
        batch : Batch
            messages
        chosen : IntArray
            indices of those that are states
        """
        extent = batch.extent[chosen]
        for size in np.unique(extent[:, 1]).tolist():
            alike = np.flatnonzero(extent[:, 1] == size)
            numbers, rest = divmod(size - _FIXED_SIZE, 8)
            if numbers >= 0 and rest == 0:
                alike = self._add_all_fixed(batch, chosen, alike, numbers)
            for index in alike.tolist():
                self._add_any(batch.message(int(chosen[index])), self._position + index)
        self._position += len(chosen)

    def _add_all_fixed(self, batch: Batch, chosen: IntArray, alike: IntArray, numbers: int) -> IntArray:
        """Take the messages of fixed layouts with so many numbers in ``heard`` and ``state``; the others come back."""
        at = batch.extent[chosen[alike], :1] + np.arange(_HEARD_COUNT, _HEARD_COUNT + 4)
        counts = np.ascontiguousarray(np.frombuffer(batch.data, np.uint8)[at]).view("<u4")[:, 0]
        others = [alike[counts > numbers]]
        for heard in np.unique(counts[counts <= numbers]).tolist():
            layout = _layout(numbers - heard, heard)
            others.append(self._add_fixed(batch, chosen, alike[counts == heard], layout))
        return np.sort(np.concatenate(others))

    def _add_fixed(self, batch: Batch, chosen: IntArray, alike: IntArray, layout: np.dtype[np.void]) -> IntArray:
        """Take the messages of the fixed layout; the indices of the others come back."""
        start = batch.extent[chosen[alike], 0]
        data = np.frombuffer(batch.data, np.uint8)
        raw = np.lib.stride_tricks.sliding_window_view(data, layout.itemsize)[start]
        table = np.ascontiguousarray(raw).view(layout)[:, 0]
        fixed = (
            (table["header"] == np.void(LITTLE_ENDIAN))
            & (table["frame_id"] == np.void(b"\x01\x00\x00\x00\x00"))
            & (table["replicas"] == table["state"].shape[1])
        )
        runs, owner = np.unique(table["run"][fixed], return_inverse=True)
        position = self._position + alike[fixed]
        table = table[fixed]
        for number, run in enumerate(runs):
            self._append(run.tobytes(), position[owner == number], table[owner == number])
        return np.asarray(alike[~fixed])

    def _append(self, run: bytes, position: IntArray, table: AnyArray) -> None:
        agent, mode = table["agent"].astype(np.int64), table["mode"].astype(np.int64)
        step = np.minimum(table["step"], np.uint64(2**63 - 1)).astype(np.int64)
        count, heard = table["heard_count"].astype(np.int64), table["heard"].astype(np.uint64)
        stamp = table["seconds"].astype(np.int64) * SECOND + table["nanoseconds"]
        states = States(position, agent, step, mode, table["state"].astype(np.float64), count, heard, stamp)
        self._columns.setdefault((run, states.state.shape[1]), []).append(states)

    def _add_any(self, data: bytes, position: int) -> None:
        try:
            message = AgentState.decode(data)
        except CdrError:
            self.undecodable += 1
            return
        table = np.zeros(1, _layout(len(message.state), len(message.heard)))
        table["agent"], table["step"], table["mode"] = message.agent, message.step, message.mode
        table["seconds"], table["nanoseconds"] = divmod(message.stamp, SECOND)
        table["state"], table["heard"], table["heard_count"] = message.state, message.heard, len(message.heard)
        self._append(message.run, np.array([position]), table)

    def runs(self) -> dict[bytes, int]:
        """Number of states of each run."""
        counts: dict[bytes, int] = {}
        for (run, _), parts in self._columns.items():
            counts[run] = counts.get(run, 0) + sum(len(part.step) for part in parts)
        return counts

    def take(self, run: bytes, replicas: int, most_heard: int = 0) -> States:
        """The states of a run with so many replicas, in the order of the bag; they are gone from here
        afterwards.

        Parameters
        ----------
        run : bytes
            16 bytes of its id
        replicas : int
            length of a state
        most_heard : int
            how many entries of ``heard`` are wanted
        """
        none = np.empty(0, np.int64)
        empty = States(none, none, none, none, np.empty((0, replicas)), none, np.empty((0, 0), np.uint64), none)
        parts = self._columns.pop((run, replicas), []) or [empty]
        position = np.concatenate([part.position for part in parts])
        order = np.argsort(position, kind="stable")
        names = ("agent", "step", "mode", "heard_count", "stamp")
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        agent, step, mode, heard_count, stamp = (column[order] for column in columns)
        state = np.concatenate([part.state for part in parts])
        heard = np.zeros((len(order), most_heard), np.uint64)
        ends = np.cumsum([len(part.step) for part in parts]).tolist()
        for part, end in zip(parts, ends, strict=True):
            width = min(most_heard, part.heard.shape[1])
            heard[end - len(part.step) : end, :width] = part.heard[:, :width]
        if not np.array_equal(order, np.arange(len(order))):
            state, heard = state[order], heard[order]
        return States(position[order], agent, step, mode, state, heard_count, heard, stamp)
