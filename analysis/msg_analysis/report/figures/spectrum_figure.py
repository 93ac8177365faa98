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


"""Figure of the autocovariance and the spectral density of the errors, predicted and, of a run, measured."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from msg_analysis.common.files import write_whole
from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.errors import InputError
from msg_analysis.inference.errors.autocovariance import LoggedAutocovariance, LoggedDensity
from msg_analysis.report.figures.matplotlib_style import STYLE, plain, rendered
from msg_analysis.report.figures.palette import BLACK, LINE_COLOURS, SKY, VERMILLION, shorten
from msg_analysis.report.figures.result_figures import NotebookFigure, stacked_panels
from msg_analysis.theory.spectrum import Spectrum

FORMATS = ("png", "svg", "pdf")
_DPI = 150


def require_format(file: Path) -> str:
    """The format that the name of a file says; InputError: none that is written."""
    kind = file.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise InputError(f"{file}: expected a name that ends with .png, .svg or .pdf")
    return kind


def write_spectrum(figure: NotebookFigure, file: Path) -> Path:
    """Write it in the format of its name, whole or not at all."""
    return write_whole(file, rendered(figure, require_format(file), _DPI))


def spectrum_figure(
    spectrum: Spectrum, log: LoggedAutocovariance | None = None, density: LoggedDensity | None = None
) -> NotebookFigure:
    """Autocovariance over the lag, and density over the frequency: of the system, and of some agents."""
    experiment = spectrum.prediction.experiment
    with mpl.rc_context(STYLE):
        figure, (above, below) = stacked_panels(2.7, 2.9)
        above.plot(spectrum.times, spectrum.system_autocovariance, color=BLACK, lw=1.5, label="system, predicted")
        below.plot(spectrum.frequencies, spectrum.system_density, color=BLACK, lw=1.5)
        for agent in range(min(experiment.agents, len(LINE_COLOURS))):
            label = plain(shorten(f"agent {agent_name(agent + 1, experiment.names)}"))
            colour = LINE_COLOURS[agent % len(LINE_COLOURS)]
            above.plot(spectrum.times, spectrum.node_autocovariances[:, agent], color=colour, lw=0.8, label=label)
            below.plot(spectrum.frequencies, spectrum.node_densities[:, agent], color=colour, lw=0.8)
        if density is not None:
            inner = slice(1, -1)  # at its ends, Welch's density is half of the one-sided one
            below.plot(density.frequencies[inner], density.system[inner], color=SKY, lw=3.0, zorder=1)
            above.plot([], [], color=SKY, lw=3.0, label="density of the log (Welch)")
        if log is not None:
            half = HALF_WIDTH_95 * log.standard_errors
            above.errorbar(
                log.times, log.corrected, half, fmt="o", color=VERMILLION, ms=3.5, lw=1.2, label="measured, 95 %"
            )
        _finish(above, below, plain(experiment.name))
        figure.legend(*above.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    return figure


def _finish(above: Axes, below: Axes, title: str) -> None:
    above.axhline(0.0, color=BLACK, lw=0.5)
    above.set(xlabel="lag [simulated time]", ylabel="autocovariance")
    above.set_title(title, loc="left")
    below.set(xlabel="frequency [cycles per unit of simulated time]", ylabel="spectral density", xscale="log")
    if any((np.asarray(line.get_ydata()) > 0.0).any() for line in below.get_lines()):
        below.set_yscale("log")
