# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""ROS 2 networks of agents under Markov-switching graphs.

    from msg_agents import run_network

The public names are imported at their first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_agents.run.result import RunResult, conclude
    from msg_agents.run.runner import run_network

    __version__: str

__all__ = ["RunResult", "conclude", "run_network"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_agents.run import result, runner

    return getattr(runner if name == "run_network" else result, name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("msg_agents")
    except PackageNotFoundError:  # run from a source tree, not installed
        return "0.0.0"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
