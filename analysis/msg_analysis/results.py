# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Experiments and results with what the layers below them cannot do: plans, figures.

The names of results are those of ``msg_analysis`` itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from msg_analysis.common.text.markdown import markdown_table
from msg_analysis.inference.verdict import comparison as verdict
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.theory import prediction as theory
from msg_analysis.theory import spectrum as spectra

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from msg_analysis.inference.planning.plan import RunPlan
    from msg_analysis.report.export.data_frame import Table


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
        from msg_analysis.inference.planning.plan import plan  # here: it is slow to import, and few need it

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
        from msg_analysis.report.figures.spectrum_figure import spectrum_figure  # here: it loads matplotlib

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
        from msg_analysis.report.export.data_frame import data_frame  # here: it loads pyarrow and pandas

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
        from msg_analysis.report.figures.result_figures import run_figure  # here: it loads matplotlib

        return run_figure(self, agents, replica)


class Comparison(verdict.Comparison):
    """The result of a comparison of runs with their prediction.

    The attributes are those of :class:`msg_analysis.inference.verdict.comparison.Comparison`.
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
        from msg_analysis.report.figures.result_figures import comparison_figure  # here: it loads matplotlib

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
        from msg_analysis.report.figures.result_figures import prediction_figure  # here: it loads matplotlib

        return prediction_figure(self)
