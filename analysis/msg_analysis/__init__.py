# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Theory, bags and statistics of Markov-switching networks, free of ROS.

    from msg_analysis import Experiment, compare, read_bag

The names are those of ``msg_analysis.api``. Each is imported on first access: a program loads only what it uses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_analysis.api import (
        BagError,
        Comparison,
        Experiment,
        ExperimentError,
        InputError,
        Moments,
        NotAvailableError,
        Prediction,
        Run,
        Selection,
        Transient,
        compare,
        read_bag,
        write_report,
    )
    from msg_analysis.common.resources import __version__ as __version__

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


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from msg_analysis.common.resources import __version__

        return __version__
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_analysis import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
