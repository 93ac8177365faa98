# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A log of any origin: states at any times, and the path of the graphs in continuous time.

Not a ``Run``: that has steps, a record with a seed, and a graph for every step; a log of others has none of these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.text import markdown_table, number_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment

if TYPE_CHECKING:
    import pandas as pd

    from msg_analysis.inference.log_verdict import LogComparison

SampledLaw = Literal["continuous", "steps"]
LARGEST = 1e15  # state or noise: its square, times that of the start, is a number of single precision
LONGEST = 1e6  # interval [units of simulated time]: the matrices of a longer one lose their digits
HIDDEN = "hidden"  # a path of graphs that is not known


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Log:
    """States of the agents of a law, and the graphs between them.

    Attributes
    ----------
    law
        the experiment whose law is tested; of its section ``run`` only ``dt`` is used, and only by the law of the steps
    times
        (N,) of the samples, ascending [units of simulated time]
    states
        (N, m, R) measured states of R coordinates that move independently under the same graphs; NaN: not measured
    starts, graphs
        (p,) where the stretches of the path begin [units of simulated time], and their graphs, indices from 0; empty
        where the path is not known
    measurement_noise
        (m,) standard deviations of the measurement noise; None: estimated from the log, the same for all agents
    sampled_law
        "continuous" (the differential equation of the paper), or "steps" (the steps of length ``dt`` of a run)
    notes
        what was left out of the log, one sentence each
    """

    law: Experiment
    times: FloatArray
    states: FloatArray
    starts: FloatArray
    graphs: IntArray
    measurement_noise: FloatArray | None
    sampled_law: SampledLaw = "continuous"
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        switches = "hidden graphs" if self.hidden else f"{len(self.starts) - 1} switches"
        return (
            f"<Log of {self.law.agents} agents: {len(self.times)} samples in {self.times[-1] - self.times[0]:g} units "
            f"of time, {switches}; law {self.law.name!r}>"
        )

    def _repr_markdown_(self) -> str:
        rows = [
            ("agents", str(self.law.agents)),
            ("coordinates", str(self.states.shape[2])),
            ("samples", str(len(self.times))),
            ("span", number_text(float(self.times[-1] - self.times[0]))),
            ("switches", HIDDEN if self.hidden else str(len(self.starts) - 1)),
            ("values missing", str(int(np.isnan(self.states).any(axis=2).sum()))),
        ]
        return f"**Log**, law {self.law.name}, {self.sampled_law}\n\n" + markdown_table(("", ""), rows)

    @property
    def hidden(self) -> bool:
        """Whether the path of the graphs is not known."""
        return not len(self.starts)

    @classmethod
    def from_arrays(
        cls,
        times: ArrayLike,
        states: ArrayLike,
        *,
        law: Experiment,
        graph: str | tuple[ArrayLike, Sequence[str]] | None = None,
        measurement_noise: float | Sequence[float] | Literal["estimate"] = 0.0,
        sampled_law: SampledLaw | None = None,
        notes: Sequence[str] = (),
    ) -> Self:
        """Make a log of arrays.

        Parameters
        ----------
        times
            (N,) of the samples [units of simulated time], strictly ascending
        states
            (N, m) or (N, m, R), see the class; NaN where an agent was not measured
        law
            the experiment
        graph
            the name of the one graph that was there all the time, or (p,) times and names of the graphs from then on;
            None: the only graph of the law; "hidden": not known
        measurement_noise
            standard deviation, or one per agent; "estimate": from the log
        sampled_law
            see the class; None: "continuous" in continuous time, else "steps"
        notes
            see the class

        Raises
        ------
        InputError
            arrays of other shapes, times that do not ascend, an unknown graph, or a law that cannot be tested
        """
        moments, values = _floats("times", times), _floats("states", states)
        values = values[:, :, None] if values.ndim == 2 else values
        if moments.ndim != 1 or values.ndim != 3 or values.shape[:2] != (len(moments), law.agents):
            shape = f"times {moments.shape}, states {values.shape}"
            raise InputError(f"{shape}: expected (N,) and (N, {law.agents}) or (N, {law.agents}, coordinates)")
        if len(moments) < 2 or not np.isfinite(moments).all() or (np.diff(moments) <= 0).any():
            raise InputError("times: expected at least two finite numbers that ascend")
        if (np.abs(values) > LARGEST).any():
            wanted = f"expected at most {LARGEST:g}, or NaN where an agent was not measured: are the units right?"
            raise InputError(f"states: up to {np.nanmax(np.abs(values)):g}: {wanted}")
        if (gap := float(np.diff(moments).max())) > LONGEST:
            raise InputError(
                f"times: {gap:g} units without a sample: expected at most {LONGEST:g}: are the units right?"
            )
        starts, graphs = _path(law, graph, moments[0])
        first = int(np.searchsorted(moments, starts[0])) if len(starts) else 0
        if first:
            notes = [*notes, f"{first} samples before the first graph are not used"]
        if len(moments) - first < 2:
            raise InputError(f"graph: the first is known at {starts[0]:g}, after the samples: are the clocks the same?")
        noise = None
        if not isinstance(measurement_noise, str):
            noise = np.asarray(measurement_noise, dtype=float)
            if (
                noise.shape not in ((), (law.agents,))
                or not np.isfinite(noise).all()
                or (noise < 0).any()
                or (noise > LARGEST).any()
            ):
                wanted = f"expected a number from 0 to {LARGEST:g}, {law.agents} of them, or 'estimate'"
                raise InputError(f"measurement_noise: {str(measurement_noise)[:60]}: {wanted}")
            noise = np.broadcast_to(noise, law.agents).copy()
        elif measurement_noise != "estimate":
            raise InputError(f"measurement_noise: {measurement_noise!r}: expected a number >= 0 or 'estimate'")
        chosen: SampledLaw = sampled_law or ("continuous" if law.time == "continuous" else "steps")
        return cls(law, moments[first:], values[first:], starts, graphs, noise, chosen, tuple(notes))

    @classmethod
    def from_dataframe(cls, frame: pd.DataFrame, *, law: Experiment, **options: Any) -> Self:
        """Make a log of a data frame with a column ``time``, one for each agent, and maybe ``graph``.

        Parameters
        ----------
        frame
            columns of agents are called by number or name; ``graph`` has the name of the graph from that row on
        law
            the experiment
        options
            as of ``from_arrays``

        Raises
        ------
        InputError
            a column is missing, or as for ``from_arrays``
        """
        columns = {str(name): frame[name].to_numpy() for name in frame.columns}
        return cls.from_columns(columns, law=law, **options)

    @classmethod
    def from_columns(cls, columns: Mapping[str, Any], *, law: Experiment, **options: Any) -> Self:
        """The same of arrays (N,) by name; see ``from_dataframe``."""
        agents = [agent_column(columns, law, number) for number in range(1, law.agents + 1)]
        if "time" not in columns:
            raise InputError(f"columns {', '.join(columns)}: expected one called time")
        times = _floats("column time", columns["time"])
        order = np.argsort(times, kind="stable")
        states = np.column_stack([_floats(f"column {name}", columns[name]) for name in agents])[order]
        if "graph" in columns and "graph" not in options:
            names = np.asarray(columns["graph"]).astype(str)[order]
            changes = np.flatnonzero(np.concatenate([[True], names[1:] != names[:-1]]))
            options["graph"] = (times[order][changes], names[changes].tolist())
        return cls.from_arrays(times[order], states, law=law, **options)

    def compare(self, *, level: float = 0.01) -> LogComparison:
        """Whether the log follows the law.

        Parameters
        ----------
        level
            probability of a false "disagrees", all tests together; above 0, at most 0.5

        Raises
        ------
        InputError
            an invalid level, a law that a log cannot be compared with, or too few samples
        """
        from msg_analysis.inference.log_verdict import compare_log

        return compare_log(self, level)


def agent_column(columns: Mapping[str, Any], law: Experiment, number: int) -> str:
    """The column of an agent, from 1; InputError: there is none."""
    names = [str(number), *([law.names[number - 1]] if law.names else []), f"x{number}", f"agent_{number}"]
    found = next((name for name in names if name in columns), None)
    if found is None:
        raise InputError(f"columns {', '.join(map(str, columns))}: expected one of {', '.join(names)}")
    return found


def _floats(what: str, values: ArrayLike) -> FloatArray:
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: expected numbers ({error})") from error


def _path(
    law: Experiment, graph: str | tuple[ArrayLike, Sequence[str]] | None, first: float
) -> tuple[FloatArray, IntArray]:
    names = [each.name for each in law.graph_list]
    if graph == HIDDEN and HIDDEN not in names:
        if len(names) > 1:
            return np.empty(0), np.empty(0, dtype=np.int64)
        graph = None
    if graph is None and len(names) > 1:
        raise InputError(f"graph: missing: expected which of {', '.join(names)} was there when, or 'hidden'")
    if graph is None or isinstance(graph, str):
        graph = ([first], [graph or names[0]])
    starts = _floats("times of the graphs", graph[0])
    unknown = sorted(set(map(str, graph[1])) - set(names))
    if unknown:
        raise InputError(f"graph: {unknown[0]}: expected one of {', '.join(names)}")
    if starts.shape != (len(graph[1]),) or not len(starts) or (np.diff(starts) < 0).any():
        raise InputError("times of the graphs: expected one for each graph, ascending")
    graphs = np.array([names.index(str(name)) for name in graph[1]], dtype=np.int64)
    # Of graphs at the same time the last one counts; and one that is told again is no switch.
    kept = np.append(np.diff(starts) > 0, True)
    starts, graphs = starts[kept], graphs[kept]
    changes = np.concatenate([[True], graphs[1:] != graphs[:-1]])
    return starts[changes], graphs[changes]
