"""State messages as columns: where they have the agents' own layout, a batch is one numpy record array."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from msg_analysis.bags.cdr import LITTLE_ENDIAN, RUN_SIZE, AgentState, CdrError
from msg_analysis.bags.mcapfile import Batch
from msg_analysis.types import AnyArray, FloatArray, IntArray

_FIXED_SIZE = 68  # bytes of an AgentState before its state, where frame_id and heard are empty


def _layout(replicas: int) -> np.dtype[np.void]:
    """Of an AgentState with empty ``frame_id`` and ``heard``; its own bytes, padding left out."""
    fields = {
        "header": ("V4", 0),
        "frame_id": ("V5", 12),
        "run": (f"V{RUN_SIZE}", 17),
        "agent": ("<u4", 36),
        "step": ("<u8", 44),
        "mode": ("<u4", 52),
        "heard": ("<u4", 56),
        "replicas": ("<u4", 60),
        "state": (("<f8", (replicas,)), _FIXED_SIZE),
    }
    return np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": _FIXED_SIZE + 8 * replicas,
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
    """

    position: IntArray
    agent: IntArray
    step: IntArray
    mode: IntArray
    state: FloatArray


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
            replicas, rest = divmod(size - _FIXED_SIZE, 8)
            if replicas >= 0 and rest == 0:
                alike = self._add_fixed(batch, chosen, alike, _layout(replicas))
            for index in alike.tolist():
                self._add_any(batch.message(int(chosen[index])), self._position + index)
        self._position += len(chosen)

    def _add_fixed(self, batch: Batch, chosen: IntArray, alike: IntArray, layout: np.dtype[np.void]) -> IntArray:
        """Take the messages of the fixed layout; the indices of the others come back."""
        start = batch.extent[chosen[alike], 0]
        data = np.frombuffer(batch.data, np.uint8)
        raw = np.lib.stride_tricks.sliding_window_view(data, layout.itemsize)[start]
        table = np.ascontiguousarray(raw).view(layout)[:, 0]
        fixed = (
            (table["header"] == np.void(LITTLE_ENDIAN))
            & (table["frame_id"] == np.void(b"\x01\x00\x00\x00\x00"))
            & (table["heard"] == 0)
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
        states = States(position, agent, step, mode, table["state"].astype(np.float64))
        self._columns.setdefault((run, states.state.shape[1]), []).append(states)

    def _add_any(self, data: bytes, position: int) -> None:
        try:
            message = AgentState.decode(data)
        except CdrError:
            self.undecodable += 1
            return
        table = np.zeros(1, _layout(len(message.state)))
        table["agent"], table["step"], table["mode"] = message.agent, message.step, message.mode
        table["state"] = message.state
        self._append(message.run, np.array([position]), table)

    def runs(self) -> dict[bytes, int]:
        """Number of states of each run."""
        counts: dict[bytes, int] = {}
        for (run, _), parts in self._columns.items():
            counts[run] = counts.get(run, 0) + sum(len(part.step) for part in parts)
        return counts

    def take(self, run: bytes, replicas: int) -> States:
        """The states of a run with so many replicas, in the order of the bag; they are gone from here
        afterwards.

        Parameters
        ----------
        run : bytes
            16 bytes of its id
        replicas : int
            length of a state
        """
        none = np.empty(0, np.int64)
        empty = States(none, none, none, none, np.empty((0, replicas)))
        parts = self._columns.pop((run, replicas), []) or [empty]
        position = np.concatenate([part.position for part in parts])
        order = np.argsort(position, kind="stable")
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in ("agent", "step", "mode"))
        agent, step, mode = (column[order] for column in columns)
        state = np.concatenate([part.state for part in parts])
        if not np.array_equal(order, np.arange(len(order))):
            state = state[order]
        return States(position[order], agent, step, mode, state)
