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

"""Theory, bags and statistics of Markov-switching networks, free of ROS.

    from msg_analysis import Experiment, compare, read_bag

The names are those of ``msg_analysis.api``. Each is imported on first access: a program loads only what it uses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_analysis.api import BagError as BagError
    from msg_analysis.api import Comparison as Comparison
    from msg_analysis.api import Experiment as Experiment
    from msg_analysis.api import ExperimentError as ExperimentError
    from msg_analysis.api import InputError as InputError
    from msg_analysis.api import Moments as Moments
    from msg_analysis.api import NotAvailableError as NotAvailableError
    from msg_analysis.api import Prediction as Prediction
    from msg_analysis.api import Run as Run
    from msg_analysis.api import Selection as Selection
    from msg_analysis.api import Transient as Transient
    from msg_analysis.api import compare as compare
    from msg_analysis.api import read_bag as read_bag
    from msg_analysis.api import write_report as write_report
    from msg_analysis.common.version import __version__ as __version__

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
        from msg_analysis.common import version

        return version.__version__
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_analysis import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
