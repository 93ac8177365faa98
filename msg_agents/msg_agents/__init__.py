"""ROS 2 networks of agents under Markov-switching graphs.

    from msg_agents import run_network

The public names are those of ``msg_agents.running.runner``, which is imported at their first use.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_agents.running.runner import RunResult as RunResult
    from msg_agents.running.runner import conclude as conclude
    from msg_agents.running.runner import run_network as run_network

try:
    __version__ = version("msg_agents")
except PackageNotFoundError:  # run from a source tree, not installed
    __version__ = "0.0.0"

__all__ = ["RunResult", "conclude", "run_network"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_agents.running import runner

    return getattr(runner, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
