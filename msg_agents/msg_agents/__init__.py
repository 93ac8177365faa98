# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""ROS 2 networks of agents under Markov-switching graphs.

from msg_agents import ExternalAgent, run_network
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from msg_agents.nodes.external_agent import ExternalAgent
    from msg_analysis import Experiment, Run

    __version__: str

__all__ = ["ExternalAgent", "run_network"]


def run_network(experiment: str | Path | Experiment, out: str | Path = "runs", **options: Any) -> Run:
    """Run an experiment as a network of ROS 2 processes, as ``msg-agents run`` does, and read its bag.

    In the main thread, a signal ends the run in order; in others, signals are those of the main thread.

    Parameters
    ----------
    experiment
        the experiment, the path of its file, or the name of an example
    out
        directory in which the new bag is made
    **options
        those of :func:`msg_agents.run.runner.run_network`, such as ``domain`` and ``restarts``

    Returns
    -------
    Run
        as ``read_bag`` gives it; ``run.network`` has what only the network knows: ``bag``, ``restarts``, ``failures``,
        ``wall_time``, ``rate``, ``rejected_messages`` and more. A process that failed leaves states that are missing

    Raises
    ------
    NotAvailableError, InputError
        the experiment cannot be run, no domain is free, or a right is missing; nothing was started
    BagError
        nothing was recorded, or the bag cannot be read
    KeyboardInterrupt
        a signal has ended the run; its bag is kept
    """
    from dataclasses import replace
    from pathlib import Path

    from msg_agents.run.runner import run_network as run
    from msg_analysis import BagError, Experiment

    if not isinstance(experiment, Experiment):
        experiment = Experiment.load(experiment)
    result = run(experiment, Path(out), **options)
    if result.interrupted:
        raise KeyboardInterrupt(result.failures[0])
    if result.trajectory is None:
        raise BagError("; ".join(result.failures) or f"{result.bag}: no run was recorded")
    return replace(result.trajectory, network=result)


def __getattr__(name: str) -> Any:
    if name == "ExternalAgent":
        from msg_agents.nodes.external_agent import ExternalAgent

        return ExternalAgent
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("msg_agents")
    except PackageNotFoundError:  # run from a source tree, not installed
        return "0.0.0"
