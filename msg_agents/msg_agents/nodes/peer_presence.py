"""Ends a process when nodes without which its run cannot go on have left the network."""

from __future__ import annotations

import time

from msg_agents.nodes.network_node import NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_analysis.errors import InputError

PERIOD = 1.0  # s between two checks


class LeftAloneError(InputError):
    """Companions left the run before its end."""


class Presence:
    """Ends the process of a node that has begun when a companion has been gone for longer than ``patience`` s.

    A companion is gone when it has left the network or its lease has ended; ``patience`` allows for a restart. On one
    machine the supervisor ends all processes when one is lost; across hosts nothing else does.
    """

    def __init__(self, node: NetworkNode, patience: float) -> None:
        self._node, self._patience = node, patience
        self._since: dict[str, float] = {}  # monotonic time [s] since which a companion is gone, by name
        every(node, PERIOD, self._look)

    def _look(self) -> None:
        there, now = set(self._node.get_node_names()), time.monotonic()
        self._since = {name: self._since.get(name, now) for name in self._node.companions() if name not in there}
        if now - min(self._since.values(), default=now) > self._patience:
            self._node.fail(
                LeftAloneError(
                    f"{', '.join(self._since)} left the network before the end of the run, and {self._patience:g} s "
                    "were not enough to come back: see what happened on the host that runs it"
                )
            )
