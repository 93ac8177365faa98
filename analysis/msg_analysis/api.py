# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Experiments and results with what the layers below them cannot do: plans, figures.

The names of results are those of ``msg_analysis`` itself.

The Python API: experiments, runs and comparisons for scripts and notebooks.

All names can be imported from ``msg_analysis`` itself. Agents and graphs count from 0 in arrays and arguments, and from
1 in files and texts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from msg_analysis.bags.mcap_chunks import DEFAULT_STORAGE, Storage
from msg_analysis.bags.reading import read_bag as read_trajectory
from msg_analysis.bags.run_writer import write_trajectory
from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import require_place
from msg_analysis.common.text import markdown_table
from msg_analysis.errors import BagError, InputError, NotAvailableError
from msg_analysis.experiment import experiment as model
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import ValidExperiment
from msg_analysis.experiment.problems import ExperimentError
from msg_analysis.inference import comparison as verdict
from msg_analysis.inference.verdict import compare as compare_trajectory
from msg_analysis.inference.verdict import compare_pooled
from msg_analysis.model.run import Trajectory
from msg_analysis.model.run_record import RunRecord
from msg_analysis.theory import prediction as theory
from msg_analysis.theory import spectrum as spectra
from msg_analysis.theory.leader_search import SearchProgress, ignore
from msg_analysis.theory.leaders import SearchMethod, Selection, SelectionLaw, select_leaders
from msg_analysis.theory.prediction import Moments, predict
from msg_analysis.theory.transient import Transient, TransientLaw, solve_transient
from msg_analysis.twin.simulate import simulate

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from msg_analysis.inference.sample_size import RunPlan
    from msg_analysis.report.export import Table


def fields(instance: Any) -> dict[str, Any]:
    """The fields of a data class, not copied."""
    return {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)}


class PlannedExperiment(ValidExperiment):
    """An experiment with the plan of its runs, and their spectrum."""

    __slots__ = ()

    def plan(
        self, precision: float = 0.01, *, seconds: float | None = None, rate: float | None = None, level: float = 0.01
    ) -> RunPlan:
        """What runs will show, before any run: length and replicas for a precision, time, power for faults.

        Parameters
        ----------
        precision
            half-width of the 95 % interval of the system error that is sought, relative to the predicted error; above
            0, below 1
        seconds
            time budget [s] for which the best number of replicas is sought; None: none
        rate
            steps per second of a run in lockstep, such as ``msg-agents run`` prints; None: not known, or in real time,
            where the clock says it
        level
            probability of a false "disagrees", all tests together; above 0, at most 0.5

        Returns
        -------
        RunPlan
            ``precision`` (standard error of any length, and the reverse), ``powers`` (one per fault), ``to_json()``

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            an argument that is not valid, a system error of 0, or one whose variance is not finite
        """
        from msg_analysis.inference.sample_size import plan  # here: it is slow to import, and few need it

        self.require_available("predict")
        return plan(theory.predict(self), precision, seconds=seconds, rate=rate, level=level)

    def spectrum(self, lags: ArrayLike | None = None, frequencies: ArrayLike | None = None) -> Spectrum:
        """Autocovariance and spectral density of the errors in the steady state, exactly.

        Parameters
        ----------
        lags
            (L,) ascending, >= 0 [steps]; None: up to 200, from 0 to where 1 % of lag 0 is left
        frequencies
            (F,) ascending, from 0 to 1 / (2 dt) [cycles per unit of simulated time]; None: 200, equally spaced on a
            logarithmic axis

        Returns
        -------
        Spectrum
            ``covariances`` (L, m, m), ``system_autocovariance`` (L,), ``system_density`` (F,), ``node_densities``
            (F, m)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            lags or frequencies that are not valid, too large, or without finite steady errors
        """
        self.require_available("predict")
        wanted = None if lags is None else np.asarray(lags, dtype=np.int64)
        where = None if frequencies is None else np.asarray(frequencies, dtype=float)
        return Spectrum.of(spectra.spectrum(theory.predict(self), wanted, where))


class Spectrum(spectra.Spectrum):
    """Predicted autocovariance and spectral density of the errors.

    The attributes are those of :class:`msg_analysis.theory.spectrum.Spectrum`.
    """

    __slots__ = ()

    @classmethod
    def of(cls, spectrum: spectra.Spectrum) -> Self:
        """The same spectrum with the methods of this class.

        Parameters
        ----------
        spectrum
            of an experiment
        """
        return spectrum if isinstance(spectrum, cls) else cls(**fields(spectrum))

    def plot(self) -> Figure:
        """Draw the autocovariance over the lag, and the density over the frequency.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("spectrum.png")`` writes it
        """
        from msg_analysis.report.figures import spectrum_figure  # here: it loads matplotlib

        return spectrum_figure(self)


class ShownRun(Trajectory):
    """A run that can be shown: as a table, a data frame and a figure."""

    __slots__ = ()

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
        from msg_analysis.report.export import data_frame  # here: it loads pyarrow and pandas

        return data_frame(self, table)

    def plot(self, agents: Sequence[int] | None = None, *, replica: int = 0) -> Figure:
        """Draw the states of agents over time, and the graph of every step.

        Parameters
        ----------
        agents
            indices from 0; None: the first eight
        replica
            from 0

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("run.png")`` writes it

        Raises
        ------
        InputError
            there is no such agent or replica
        """
        from msg_analysis.report.figures import run_figure  # here: it loads matplotlib

        return run_figure(self, agents, replica)


class Comparison(verdict.Comparison):
    """The result of a comparison of runs with their prediction.

    The attributes are those of :class:`msg_analysis.inference.comparison.Comparison`.
    """

    __slots__ = ()

    @classmethod
    def of(cls, comparison: verdict.Comparison) -> Self:
        """The same comparison with the methods of this class.

        Parameters
        ----------
        comparison
            of one run or several
        """
        return comparison if isinstance(comparison, cls) else cls(**fields(comparison))

    def plot(self) -> Figure:
        """Draw the system error up to each time and the agents' errors, with 95 % intervals, beside the prediction.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("comparison.png")`` writes it
        """
        from msg_analysis.report.figures import comparison_figure  # here: it loads matplotlib

        return comparison_figure(self)


class Prediction(theory.Prediction):
    """The exact steady second moments of an experiment.

    The attributes are those of :class:`msg_analysis.theory.prediction.Prediction`.
    """

    @classmethod
    def of(cls, prediction: theory.Prediction) -> Self:
        """The same prediction with the methods of this class.

        Parameters
        ----------
        prediction
            of an experiment
        """
        return prediction if isinstance(prediction, cls) else cls(**fields(prediction))

    def plot(self) -> Figure:
        """Draw the agents' errors in the steady state, by every law that there is.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("prediction.png")`` writes it
        """
        from msg_analysis.report.figures import prediction_figure  # here: it loads matplotlib

        return prediction_figure(self)


__all__ = [
    "BagError",
    "Comparison",
    "Experiment",
    "ExperimentError",
    "InputError",
    "Moments",
    "NotAvailableError",
    "Prediction",
    "Run",
    "Selection",
    "Transient",
    "compare",
    "read_bag",
    "write_report",
]


class Experiment(PlannedExperiment):
    """A Markov-switching network and one run of it.

    Make one with :meth:`load` (a file) or :meth:`parse` (a dictionary); :meth:`with_run` changes its run.
    """

    __slots__ = ()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an experiment file (YAML, of which JSON is a part), or an example that is installed with this package.

        Parameters
        ----------
        path
            of the file, or the name of an example, such as ``line_ring``; a file of that name in the current
            directory, with or without ``.yaml``, wins. Paths in a file are relative to its directory

        Raises
        ------
        InputError
            there is neither a file nor an example, the file cannot be read, or it is not YAML
        ExperimentError
            the experiment is not valid; names every mistake
        """
        return super().load(find(path))

    @classmethod
    def of(cls, experiment: model.ValidExperiment) -> Self:
        """The same experiment with the methods of this class.

        Parameters
        ----------
        experiment
            already checked, such as that of a recorded run

        Returns
        -------
        Experiment
            ``experiment`` itself if it is of this class already
        """
        return experiment if isinstance(experiment, cls) else cls(**fields(experiment))

    def predict(self) -> Prediction:
        """The exact steady second moments; see :func:`msg_analysis.theory.prediction.predict`.

        Returns
        -------
        Prediction
            ``emulated`` (the steps of the run), ``continuous`` (the paper's law) and ``static`` (each graph held
            fixed); the last two are None where they do not exist. Each has ``system_error``, ``node_errors`` (m,),
            ``node_certainty`` (m,) and ``covariance`` (m, m)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            too large, or without finite steady errors
        """
        self.require_available("predict")
        return Prediction.of(predict(self))

    def transient(self, times: ArrayLike, *, law: TransientLaw = "emulated", unreduced: bool = False) -> Transient:
        """The exact moments over time from the experiment's own start.

        Parameters
        ----------
        times
            (T,) ascending, >= 0 [units of simulated time]; multiples of ``run.dt`` in the emulated law
        law
            "emulated" (the steps of the run) or "continuous" (the paper's)
        unreduced
            consensus only: moments of the states themselves, which grow without bound, not of the disagreement

        Returns
        -------
        Transient
            ``times`` as given, ``system_error`` (T,), ``node_errors`` (T, m), ``mean`` (T, m)

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            invalid times, a law or ``unreduced`` that does not exist here, too large, or no finite steady errors
        """
        self.require_available("predict")
        given = np.asarray(times, dtype=float)
        return dataclasses.replace(solve_transient(self, given, law=law, unreduced=unreduced).course, times=given)

    def simulate(
        self, *, seed: int | None = None, duration: float | None = None, record: RunRecord | None = None
    ) -> Run:
        """Run the experiment without ROS: the offline twin of a network.

        Parameters
        ----------
        seed
            replaces ``run.seed``
        duration
            replaces ``run.duration`` [units of simulated time]
        record
            of a run to repeat; its experiment, seed and duration are then used instead of these. By default a new run

        Returns
        -------
        Run
            equal, to the last bit, to a network run in lockstep; in real time, to one with ideal timers and no delay

        Raises
        ------
        ExperimentError
            the seed or the duration is not valid
        NotAvailableError
            the experiment asks for something that runs do not have yet
        InputError
            the stationary start cannot be computed: too large, or no finite steady errors
        """
        changes = {key: value for key, value in {"seed": seed, "duration": duration}.items() if value is not None}
        experiment = self.with_run(**changes) if changes else self
        experiment.require_available()
        return Run.of(simulate(experiment, record=record))

    def select_leaders(
        self,
        count: int | None = None,
        *,
        method: SearchMethod = "auto",
        law: SelectionLaw | None = None,
        gain: float | None = None,
        top: int = 10,
        watch: SearchProgress = ignore,
    ) -> Selection:
        """The sets of leaders with the least system error, and that of the experiment's own leaders.

        At infinite gain these are the sets of largest joint robustness centrality.

        Parameters
        ----------
        count
            number of leaders; None: as many as the experiment has
        method
            "exhaustive" (every set), "greedy" or "swap" (good sets), or "auto": exhaustive up to 1000 sets, else swap
        law
            "continuous" (the paper's), "emulated" (the steps of the run) or "discrete"; by default the paper's where
            there is one, else that of the steps
        gain
            pull of the leaders [1 / unit of simulated time]; inf holds them at the reference; None: that of the
            experiment's leaders, inf in consensus
        top
            most sets in the result
        watch
            called during the search with its stage, evaluations done, of how many, and the least system error so far

        Returns
        -------
        Selection
            ``sets``: (system error, agents from 0), best first; ``present``: that of the experiment's own leaders

        Raises
        ------
        NotAvailableError
            the experiment asks for something that cannot be predicted
        InputError
            an impossible count, gain or law; no count in consensus; too many sets; no set that reaches all agents
        """
        self.require_available("predict")
        return select_leaders(self, count, method=method, law=law, gain=gain, top=top, watch=watch)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run(ShownRun):
    """A run of an experiment, by a network or by the twin: states and graphs of every step.

    The arrays are those of :class:`msg_analysis.model.run.Trajectory`. A missing state is NaN, a missing
    graph -1; ``completeness`` counts them.
    """

    @classmethod
    def of(cls, trajectory: Trajectory) -> Self:
        """The same run with the methods of this class.

        Parameters
        ----------
        trajectory
            of a bag or of the twin; its arrays are shared, not copied
        """
        return trajectory if isinstance(trajectory, cls) else cls(**fields(trajectory))

    @property
    def experiment(self) -> Experiment:
        """The experiment that was run."""
        return Experiment.of(self.record.experiment)

    @property
    def times(self) -> FloatArray:
        """(N + 1,) simulated time of the states x(0), ..., x(N) [units of simulated time]."""
        return np.asarray(np.arange(len(self.states)) * self.record.experiment.step_length, dtype=float)

    def compare(self, *, level: float = 0.01) -> Comparison:
        """Compare the run with its prediction; see :func:`compare`.

        Parameters
        ----------
        level
            probability of a false "disagrees", all tests together; above 0, at most 0.5

        Raises
        ------
        InputError
            an invalid level, or no prediction (too large, or without finite steady errors)
        """
        return compare(self, level=level)

    def save(self, directory: str | Path, storage: Storage = DEFAULT_STORAGE) -> Path:
        """Write the run as a bag with the topics and the layout of a network's.

        Parameters
        ----------
        directory
            of the bag; must not exist
        storage
            compression and size of its files

        Returns
        -------
        Path
            the directory

        Raises
        ------
        BagError
            the directory exists or cannot be written
        """
        write_trajectory(self, directory, storage)
        return Path(directory)


def read_bag(path: str | Path) -> Run:
    """Read the run in a bag of msg-agents, the twin or ``ros2 bag``; torn and damaged bags as far as possible.

    Parameters
    ----------
    path
        directory of a bag, or one of its files (.mcap, .db3)

    Returns
    -------
    Run
        ``states`` (N + 1, m, replicas), ``modes`` (N,), ``times`` (N + 1,), and ``completeness``

    Raises
    ------
    BagError
        not a bag, a bag without the run record, or with several runs
    InputError
        the run record in it is not valid
    """
    return Run.of(read_trajectory(path))


def compare(*runs: Trajectory | str | Path, level: float = 0.01) -> Comparison:
    """Compare a run, or several of one experiment, with what theory predicts.

    Parameters
    ----------
    *runs
        runs, or paths of their bags, which are read one after the other; several runs need different seeds and get one
        verdict together
    level
        probability of a false "disagrees", all tests together; above 0, at most 0.5

    Returns
    -------
    Comparison
        ``verdict``, ``system_error``, ``node_errors``, ``covariance``, ``tests``, ``blame`` and more

    Raises
    ------
    InputError
        no run, an invalid level, runs that do not belong together, or no prediction (too large, or without finite
        steady errors)
    BagError
        a path without a readable run
    """
    if not runs:
        raise InputError("no run: give at least one, or the path of its bag")
    if not 0.0 < level <= 0.5:
        raise InputError(f"level: {level:g}: expected a probability above 0, at most 0.5")
    if len(runs) == 1:
        return Comparison.of(compare_trajectory(_read(runs[0]), level=level))
    absent = [str(path) for path in runs if not isinstance(path, Trajectory) and not Path(path).exists()]
    if absent:
        raise InputError(f"{', '.join(absent)}: not found: expected bags, {len(runs)} were given")
    named = ((_name(run, place), _read(run)) for place, run in enumerate(runs, start=1))
    return Comparison.of(compare_pooled(named, level=level))


def write_report(comparison: Comparison, file: str | Path, **options: Any) -> Path:
    """Write a comparison as one self-contained HTML page.

    Parameters
    ----------
    comparison
        of :func:`compare`
    file
        path of the page; replaced if it exists
    **options
        what the network reported, if known: ``restarts``, a line per process that was restarted; ``strangers``, a
        mapping with ``node``, ``topic``, ``reason`` and ``count`` per kind of refused message; ``events``, a
        mapping with ``kind`` ("killed", "back" or "refused"), ``step`` and ``words`` per event; ``wall_time``, the
        seconds that the run took

    Returns
    -------
    Path
        the file

    Raises
    ------
    InputError
        the file cannot be written
    """
    from msg_analysis.report.page import write_report as write_html

    require_place(Path(file))
    write_html(comparison, comparison.trajectory, Path(file), **options)
    return Path(file)


def _read(run: Trajectory | str | Path) -> Trajectory:
    return run if isinstance(run, Trajectory) else read_trajectory(run)


def _name(run: Trajectory | str | Path, place: int) -> str:
    return f"run {place}" if isinstance(run, Trajectory) else str(run)
