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

"""Keys and columns of a sweep in words, for axes and legends; a key that has none stands for itself."""

from __future__ import annotations

import re
from collections.abc import Sequence

from msg_analysis.common.text.agent_names import agent_text

_KEYS = {
    "agents": "number of agents",
    "leaders.agents": "leaders",
    "leaders.gain": "gain of the leaders",
    "leaders.reference": "reference",
    "noise.broadcast": "noise of published values",
    "noise.burst": "messages lost in a row",
    "noise.delay": "delay of messages, in steps",
    "noise.link": "noise of received values",
    "noise.loss": "loss of messages",
    "noise.loss.default": "loss of messages",
    "noise.on_loss": "in place of a lost value",
    "noise.process": "process noise",
    "problem": "problem",
    "run.dt": "step length dt",
    "run.duration": "simulated time",
    "run.pace": "pace",
    "run.delivery": "delivery",
    "run.processes": "number of processes",
    "run.replicas": "number of replicas",
    "run.seed": "seed",
    "run.speed": "speed of real time",
    "run.start": "start",
    "switching.generator": "generator",
    "switching.initial": "first graph",
    "switching.scale": "factor of the switching rates",
    "switching.transition": "transition matrix",
    "time": "time",
}
_COLUMNS = {
    "node_errors": "error of {}",
    "rate": "decay rate",
    "seconds": "computing time [s]",
    "system_certainty": "system certainty",
    "system_error": "system error",
}
_LAWS = {"continuous": "continuous time", "discrete": "discrete time", "emulated": "with steps", "static": "one graph"}


def key_words(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, such as "step length dt"; the key itself if it has none. ``names``: of the agents."""
    if key in _KEYS:
        return _KEYS[key]
    if found := re.fullmatch(r"noise\.process\[(\d+)\]", key):
        return f"process noise of {agent_text(int(found[1]), names)}"
    if found := re.fullmatch(r"switching\.rates\.([^.]+)\.([^.]+)", key):
        return f"switching rate from {found[1]} to {found[2]}"
    return key


def axis_name(key: str, names: Sequence[str] | None = None) -> str:
    """A key in words, with the key in brackets, such as "step length dt [run.dt]"."""
    words = key_words(key, names)
    return words if words == key else f"{words} [{key}]"


def column_words(column: str, names: Sequence[str] | None = None) -> str:
    """A column in words, such as "error of agent 3"; the column itself if it has none."""
    law, _, rest = column.partition(".")
    if law in _LAWS and rest:
        return f"{column_words(rest, names)}, {_LAWS[law]}"
    found = re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", column)
    words = _COLUMNS.get(found[1]) if found else None
    if found is None or words is None or ("{}" in words) != (found[2] is not None):
        return column
    return words.format(agent_text(int(found[2]), names)) if found[2] else words
