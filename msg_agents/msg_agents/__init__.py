"""ROS 2 networks of agents under Markov-switching graphs.

    from msg_agents import run_network

The public names are those of ``msg_agents.running.runner``, which is imported at their first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_agents.running.runner import RunResult as RunResult
    from msg_agents.running.runner import conclude as conclude
    from msg_agents.running.runner import run_network as run_network

    __version__: str

__all__ = ["RunResult", "conclude", "run_network"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from msg_agents.running import runner

    return getattr(runner, name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("msg_agents")
    except PackageNotFoundError:  # run from a source tree, not installed
        return "0.0.0"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
