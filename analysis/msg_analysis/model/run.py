# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A run: states and graphs of every step, what is missing, and which values went into a state."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray, pieces, release
from msg_analysis.common.text import markdown_table
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.reception import LOST, NOTHING
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from msg_analysis.bags.stored_file import Storage
    from msg_analysis.inference.comparison import Comparison
    from msg_analysis.report.export import Table


@dataclass(frozen=True, slots=True)
class Completeness:
    """How much of a run is there, counted in states x_i(k): m (N + 1) are expected of a run of N steps.

    Where agents publish something else than their state, every state is expected twice: as it is, and as published.

    Attributes
    ----------
    expected, received, missing
        states; received counts each (agent, step) once, and none whose copies contradict each other
    duplicates
        further copies of states
    out_of_order
        states that came after a later one of the same agent
    missing_modes
        steps whose graph is not known
    refused
        number of messages that were not used, by reason
    """

    expected: int
    received: int
    missing: int
    duplicates: int = 0
    out_of_order: int = 0
    missing_modes: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    def _repr_markdown_(self) -> str:
        keys = ("expected", "received", "missing", "duplicates", "out_of_order", "missing_modes")
        rows = [(key.replace("_", " "), str(getattr(self, key))) for key in keys]
        rows += [(f"refused: {reason}", str(count)) for reason, count in self.refused.items()]
        return markdown_table(("states", "number"), rows)

    @property
    def complete(self) -> bool:
        """Whether no state and no graph is missing."""
        return self.missing == 0 and self.missing_modes == 0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run:
    """One run, ordered by step.

    Attributes
    ----------
    record
        what the run was started from
    states
        (N + 1, m, width); NaN where a state is missing. The width is the number of replicas R, or S R for a protocol
        whose state has S numbers; the first R are the agents' values
    modes
        (N,) index from 0 of the graph used in the step k -> k+1; -1 where not known
    completeness
        how many states are there and how many are missing
    agent_modes
        (N + 1, m) index from 0 of the graph that each agent says it used in the step to this state; -1 at step 0 and
        where missing. None where it was not logged
    published
        (N + 1, m, replicas) what the agents published of their states, NaN where missing; None where that is the states
        themselves
    lost
        (N, m, D) in lockstep: whether agent i did not get the newest message of its d-th neighbour, ascending, under
        the graph of the step k -> k+1 (see ``StepModel.neighbours``), that is the one with x_j(max(0, k - delay));
        False where the state is missing. D is the largest number of neighbours. None where messages cannot be lost
    used
        (N, m, D) step of the value of the d-th neighbour, ascending, that was used for x_i(k+1), under the graph
        ``agent_modes[k + 1, i]``; -1 where the agent's own value took its place because the message was lost or nothing
        had been heard, where the state is missing, and beyond the last neighbour. None in lockstep without delay and
        without ``on_loss: hold``, where it is k unless the message was lost
    made
        (N + 1, m) in real time: simulated time [ns] at which the state was made, later than that of every value used
        for it; 0 for x(0), -1 where missing. None in lockstep
    wrong_stamp
        in lockstep: step, index of the agent from 0 and stamp [ns] of the first logged state that is not stamped with
        the time of its step; None where all are, and in real time
    network
        of a run that ``msg_agents.run_network`` gives: what only the network knows, such as the directory of the
        ``bag``, ``restarts``, ``failures`` and ``wall_time``; else None
    """

    record: RunRecord
    states: FloatArray
    modes: IntArray
    completeness: Completeness
    agent_modes: IntArray | None = None
    published: FloatArray | None = None
    lost: BoolArray | None = None
    used: IntArray | None = None
    made: IntArray | None = None
    wrong_stamp: tuple[int, int, int] | None = None
    network: Any = None

    def __repr__(self) -> str:
        experiment, count = self.record.experiment, self.completeness
        whole = "complete" if count.complete else f"{count.missing} of {count.expected} states missing"
        last = len(self.states) - 1
        states = f"x(0..{last}) of {experiment.agents} agents" if last >= 0 else "no states kept"
        replicas = f"{experiment.run.replicas} replicas, seed {experiment.run.seed}"
        return f"<Run of {experiment.name!r}: {states}, {replicas}; {whole}>"

    def _repr_markdown_(self) -> str:
        experiment, count = self.record.experiment, self.completeness
        rows = [
            ("agents", str(experiment.agents)),
            ("replicas", str(experiment.run.replicas)),
            ("steps", f"{experiment.steps} of {experiment.step_length:g}"),
            ("seed", str(experiment.run.seed)),
            ("states", f"{count.received} of {count.expected}"),
            ("steps without a graph", str(count.missing_modes)),
        ]
        return f"**Run of {experiment.name}**, {experiment.run.pace}\n\n" + markdown_table(("", ""), rows)

    @property
    def experiment(self) -> Experiment:
        """The experiment that was run."""
        return self.record.experiment

    @property
    def times(self) -> FloatArray:
        """(N + 1,) simulated time of the states x(0), ..., x(N) [units of simulated time]."""
        return np.asarray(np.arange(len(self.states)) * self.record.experiment.step_length, dtype=float)

    def compare(self, *, level: float = 0.01, max_missed: float = 0.05) -> Comparison:
        """Compare the run with its prediction; see :func:`compare`.

        Parameters
        ----------
        level
            probability of a false "disagrees", all tests together; above 0, at most 0.5
        max_missed
            in real time: share of missed deadlines above which the verdict is "late"; 0 to 1

        Raises
        ------
        InputError
            an invalid level, or no prediction (too large, or without finite steady errors)
        """
        from msg_analysis.inference.pool import compare

        found = compare(self, level=level, max_missed=max_missed)
        if getattr(self.network, "bag", None) is not None:  # for the list of runs
            from msg_analysis.runs import keep_result

            with suppress(OSError):
                keep_result(Path(self.network.bag), found.to_json())
        return found

    def to_dataframe(self, table: Table = "states") -> pd.DataFrame:
        """The run as a data frame of pandas, with the columns of ``msg-analysis export``.

        Parameters
        ----------
        table
            "states" (a row per state and replica), "graphs" (a row per step) or "errors" (a row per x(k))

        Returns
        -------
        pandas.DataFrame
            agents, graphs and replicas count from 1, as in files; what is missing is NaN

        Raises
        ------
        NotAvailableError
            pandas is not installed
        InputError
            there is no such table
        """
        from msg_analysis.report.export import data_frame

        return data_frame(self, table)

    def plot(self, agents: Iterable[int | str] | None = None, *, replica: int = 1) -> Figure:
        """Draw the states of agents over time, and the graph of every step.

        Parameters
        ----------
        agents
            by number from 1 or name; None: the first eight
        replica
            number from 1

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("run.png")`` writes it

        Raises
        ------
        InputError
            there is no such agent or replica
        """
        from msg_analysis.report.figures import run_figure

        if not 1 <= replica <= self.experiment.run.replicas:
            raise InputError(f"replica: {replica}: expected a number from 1 to {self.experiment.run.replicas}")
        return run_figure(self, None if agents is None else self.experiment.indices(agents), replica - 1)

    def save(self, directory: str | Path, storage: Storage | None = None) -> Path:
        """Write the run as a bag with the topics and the layout of a network's.

        Parameters
        ----------
        directory
            of the bag; must not exist
        storage
            compression and size of its files; None: the default

        Returns
        -------
        Path
            the directory

        Raises
        ------
        BagError
            the directory exists or cannot be written
        """
        from msg_analysis.bags.stored_file import DEFAULT_STORAGE
        from msg_analysis.bags.writing import write_trajectory

        write_trajectory(self, directory, storage or DEFAULT_STORAGE)
        return Path(directory)

    def release(self) -> None:
        """Give the memory of a long run, whose arrays are in files, back to the system: after every part of it."""
        for array in (self.states, self.published, self.lost, self.used, self.made, self.agent_modes):
            if array is not None:
                release(array)

    @property
    def values(self) -> FloatArray:
        """(N + 1, m, replicas): the agents' values; they are the whole state unless a protocol has more numbers."""
        return self.states[:, :, : self.record.experiment.run.replicas]

    @property
    def present(self) -> BoolArray:
        """(N + 1, m): which states are there; what was published of them, too, where that is something else."""
        there = np.ones(self.states.shape[:2], dtype=np.bool_)
        for states in (self.states,) if self.published is None else (self.states, self.published):
            for piece in pieces(states):
                there[piece] &= ~np.isnan(states[piece]).any(axis=2)
        return there

    @property
    def prefix(self) -> int:
        """Steps in the longest complete beginning: x(0..prefix) and g(0..prefix-1) are there; -1 if x(0) is not."""
        whole = np.asarray(self.present.all(axis=1))
        states = int(np.argmin(whole)) if not whole.all() else len(whole)
        known = self.modes >= 0
        modes = int(np.argmin(known)) if not known.all() else len(known)
        return min(states - 1, modes)

    @property
    def stretch(self) -> tuple[int, int] | None:
        """First and last step of the longest stretch in which no state is missing; None where no step is complete."""
        whole = np.concatenate(([0], self.present.all(axis=1), [0])).astype(np.int64)
        first, behind = np.flatnonzero(np.diff(whole) == 1), np.flatnonzero(np.diff(whole) == -1)
        if not len(first):
            return None
        longest = int(np.argmax(behind - first))
        return int(first[longest]), int(behind[longest]) - 1


class LoggedInputs:
    """What ``heard`` can be in a run, and what it says. Agents count from 0, graphs as sent: from 1, 0 at step 0."""

    # heard (states, D) uint64 has 0 beyond its end, after count (states,) entries.

    def __init__(self, model: Wiring, experiment: Experiment) -> None:
        noise, self.realtime = experiment.noise, experiment.run.pace == "realtime"
        self.most = model.most_neighbours  # D
        self._last = np.uint64(experiment.steps)
        self._delay, self._lossy = noise.delay, noise.loss.any or self.realtime
        self.holds = noise.holds and not self.realtime  # whether an older value stands for a lost one in lockstep
        self._neighbours = np.zeros((model.modes + 1, model.agents), dtype=np.int64)  # row 0: no graph led to step 0
        for mode in range(model.modes):
            self._neighbours[mode + 1] = [len(model.neighbours(mode, i)) for i in range(model.agents)]

    def neighbours(self, mode: IntArray, agent: IntArray) -> IntArray:
        """How many neighbours these agents have in these graphs."""
        return np.asarray(self._neighbours[mode, agent])

    def newest(self, step: IntArray) -> IntArray:
        """In lockstep: steps of the newest messages that are used in the steps to states of these steps."""
        return np.maximum(0, step - 1 - self._delay)

    def fit(self, step: IntArray, mode: IntArray, agent: IntArray, heard: AnyArray, count: IntArray) -> BoolArray:
        """Whether ``heard`` is possible: one entry per neighbour in their graph, each a step that can be."""
        # In lockstep the newest one, and an empty heard says so of all; with ``holds`` an earlier one, too, else LOST.
        newest = self.newest(step).astype(np.uint64)[:, None]
        possible = heard == newest
        if self.realtime or self.holds:
            possible = heard <= (self._last if self.realtime else newest)
        if self._lossy and not self.holds:
            possible |= heard == LOST
        known = possible | (np.arange(self.most) >= count[:, None])
        fits = (count == self.neighbours(mode, agent)) & known.all(axis=1)
        return np.asarray(fits if self.realtime else fits | (count == 0))

    def used(self, step: IntArray, mode: IntArray, agent: IntArray, heard: AnyArray, count: IntArray) -> IntArray:
        """(states, D) steps of the values used; NOTHING where the own value took their place, and beyond the last."""
        there = np.arange(self.most) < self.neighbours(mode, agent)[:, None]
        newest = self.newest(step)[:, None]
        listed = np.where(heard == LOST, NOTHING, heard.astype(np.int64))
        return np.where(there, np.where(count[:, None] > 0, listed, newest), NOTHING)

    def lost(self, step: IntArray, mode: IntArray, agent: IntArray, used: IntArray) -> BoolArray:
        """(states, D) in lockstep: whether the newest message was lost, given the values ``used``."""
        there = np.arange(self.most) < self.neighbours(mode, agent)[:, None]
        return np.asarray(there & (used < self.newest(step)[:, None]))
