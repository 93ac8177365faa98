# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Theory, bags and statistics of Markov-switching networks, free of ROS.

    from msg_analysis import Experiment, compare, read_bag

Each name is imported on first access: a program loads only what it uses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_analysis.bags.reading import read_bag
    from msg_analysis.common.resources import __version__ as __version__
    from msg_analysis.errors import BagError, InputError, NotAvailableError
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.experiment.problems import ExperimentError
    from msg_analysis.inference.comparison import Comparison
    from msg_analysis.inference.pool import compare
    from msg_analysis.model.log import Log
    from msg_analysis.model.run import Run
    from msg_analysis.report.page import write_report
    from msg_analysis.sweeps.in_python import Sweep, sweep
    from msg_analysis.theory.leaders import Selection
    from msg_analysis.theory.prediction import Moments, Prediction
    from msg_analysis.theory.sampling import SampledPrediction, sampled_prediction
    from msg_analysis.theory.spectrum import Spectrum
    from msg_analysis.theory.transient import Transient

_MODULES = {
    "bags.reading": ("read_bag",),
    "errors": ("BagError", "InputError", "NotAvailableError"),
    "experiment.experiment": ("Experiment",),
    "experiment.problems": ("ExperimentError",),
    "inference.comparison": ("Comparison",),
    "inference.pool": ("compare",),
    "model.log": ("Log",),
    "model.run": ("Run",),
    "report.page": ("write_report",),
    "sweeps.in_python": ("Sweep", "sweep"),
    "theory.leaders": ("Selection",),
    "theory.prediction": ("Moments", "Prediction"),
    "theory.sampling": ("SampledPrediction", "sampled_prediction"),
    "theory.spectrum": ("Spectrum",),
    "theory.transient": ("Transient",),
}
_PLACES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "BagError",
    "Comparison",
    "Experiment",
    "ExperimentError",
    "InputError",
    "Log",
    "Moments",
    "NotAvailableError",
    "Prediction",
    "Run",
    "SampledPrediction",
    "Selection",
    "Spectrum",
    "Sweep",
    "Transient",
    "compare",
    "read_bag",
    "sampled_prediction",
    "sweep",
    "write_report",
]


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name == "__version__":
        return import_module("msg_analysis.common.resources").__version__
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"msg_analysis.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
