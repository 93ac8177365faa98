"""Whether those without whom a run cannot go on are still there."""

from __future__ import annotations

import time

from msg_agents.nodes.network_node import NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_analysis.errors import InputError

PERIOD = 1.0  # s between two looks


class LeftAloneError(InputError):
    """Others have left the run before its end."""


class Presence:
    """Ends a process whose companions have left the network, or have been out of reach for longer than their lease.

    On one machine a supervisor ends all processes when one is lost. Nobody does that for those of other hosts.

    Parameters
    ----------
    node
        of the process; it has begun
    patience
        s that they may be away, for example to be started again
    """

    def __init__(self, node: NetworkNode, patience: float) -> None:
        self._node, self._patience = node, patience
        self._since: dict[str, float] = {}  # they have been away, by name
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
