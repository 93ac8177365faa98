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

"""ROS 2 networks of agents under Markov-switching graphs.

    from msg_agents import run_network

The public names are imported at their first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_agents.running.run_result import RunResult as RunResult
    from msg_agents.running.run_result import conclude as conclude
    from msg_agents.running.runner import run_network as run_network

    __version__: str

__all__ = ["RunResult", "conclude", "run_network"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_agents.running import run_result, runner

    return getattr(runner if name == "run_network" else run_result, name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("msg_agents")
    except PackageNotFoundError:  # run from a source tree, not installed
        return "0.0.0"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
