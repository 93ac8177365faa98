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

"""What can happen to messages, and where it can be run, simulated and predicted: the table in network.md."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from msg_analysis.common.text.markdown import markdown_table
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.protocol_binding import ChosenProtocol, ProtocolInfo
from msg_analysis.protocol import Protocol

Pace = Literal["lockstep", "realtime"]

_OWN, _BURSTS = {"loss": 0.2}, {"loss": 0.2, "burst": 5}
_BY_LINK = {"loss": {"default": 0.1, "arcs": [[1, 2, 0.5]]}}
_HOLD: dict[str, Any] = {"on_loss": "hold"}
MESSAGES: dict[str, dict[str, Any]] = {
    "as they are": {},
    "`broadcast` noise": {"broadcast": 0.5},
    "`link` noise": {"link": 0.5},
    "`loss`, own value": _OWN,
    "`loss`, last value heard": _OWN | _HOLD,
    "`loss` by link, own value": _BY_LINK,
    "`loss` by link, last value heard": _BY_LINK | _HOLD,
    "`loss` in bursts, own value": _BURSTS,
    "`loss` in bursts, last value heard": _BURSTS | _HOLD,
    "`delay`": {"delay": 2},
    "all of these, own value": {"broadcast": 0.5, "link": 0.5, "delay": 2, **_BY_LINK, "burst": 5},
    "all of these, last value heard": {"broadcast": 0.5, "link": 0.5, "delay": 2, **_BY_LINK, "burst": 5, **_HOLD},
}
"""Sections ``noise``, beside the process noise, by what they make of messages."""

LAWS: dict[str, dict[str, Any]] = {
    "consensus": {},
    "leaders": {"problem": "tracking", "leaders": {"agents": [1], "gain": 1.0}},
    "leaders held at the reference": {"problem": "tracking", "leaders": {"agents": [1], "gain": "inf"}},
    "linear protocol": {},
    "protocol that is not linear": {"run": {"start": "zero"}},
}
PROCESS_NOISE: tuple[Any, ...] = (0.0, 1.0, [1.0, 0.5], [[1.0, 0.2], [0.0, 1.0]], {"a": 1.0, "b": 2.0})


def experiment(messages: str, law: str, pace: Pace, process: Any = 1.0) -> ValidExperiment:
    """One with these messages and this law; only asked what is available, since its protocol does nothing."""
    document: dict[str, Any] = {"name": "any", "graphs": {"a": {"path": [1, 2]}, "b": {"arcs": [[1, 2], [2, 1]]}}}
    document |= {"switching": {"generator": [[-1, 1], [1, -1]]}, **LAWS[law]}
    document["noise"] = {"process": process, **MESSAGES[messages]}
    document["run"] = {"pace": pace, **document.get("run", {})}
    found = ValidExperiment.parse(document)
    if "protocol" not in law:
        return found
    info = ProtocolInfo(name="any", package="any", version="1", linear=law == "linear protocol")
    return dataclasses.replace(found, protocol=ChosenProtocol(info, kind=Protocol))


def availability_table() -> str:
    """As Markdown; every kind of process noise is in every cell."""
    head = ("messages", "lockstep: run, twin", "lockstep: predicted", "real time: run, twin", "real time: predicted")
    paces: tuple[Pace, ...] = ("lockstep", "realtime")
    rows = [
        (messages, *(_cell(messages, pace, purpose) for pace in paces for purpose in ("run", "predict")))
        for messages in MESSAGES
    ]
    return markdown_table(head, rows, names=len(head))


def _cell(messages: str, pace: Pace, purpose: Any) -> str:
    missing = [
        law
        for law in LAWS
        if any(experiment(messages, law, pace, process).unavailable(purpose) for process in PROCESS_NOISE)
    ]
    if not missing:
        return "all laws"
    if len(missing) == len(LAWS):
        return "no"
    return "linear laws" if missing == ["protocol that is not linear"] else "all but " + ", ".join(missing)
