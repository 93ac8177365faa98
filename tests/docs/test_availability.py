"""What docs/network.md says is available, in "What is available"."""

import dataclasses
from typing import Any, Literal

import pytest

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.protocols import ChosenProtocol, ProtocolInfo
from msg_analysis.experiment.validation import unavailable
from msg_analysis.protocol import Protocol
from msg_analysis.twin.simulate import simulate

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


def with_messages(messages: str, law: str, pace: Pace, process: Any = 1.0) -> Experiment:
    """One with these messages and this law; only asked what is available, since its protocol does nothing."""
    document: dict[str, Any] = {"name": "any", "graphs": {"a": {"path": [1, 2]}, "b": {"arcs": [[1, 2], [2, 1]]}}}
    document |= {"switching": {"generator": [[-1, 1], [1, -1]]}, **LAWS[law]}
    document["noise"] = {"process": process, **MESSAGES[messages]}
    document["run"] = {"pace": pace, **document.get("run", {})}
    found = Experiment.parse(document)
    if "protocol" not in law:
        return found
    info = ProtocolInfo(name="any", package="any", version="1", linear=law == "linear protocol")
    return dataclasses.replace(found, protocol=ChosenProtocol(info, kind=Protocol))


def missing_laws(messages: str, pace: Pace, purpose: Any) -> list[str]:
    """The laws that are not available with these messages and some kind of process noise."""
    return [
        law
        for law in LAWS
        if any(unavailable(with_messages(messages, law, pace, process), purpose) for process in PROCESS_NOISE)
    ]


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
@pytest.mark.parametrize("messages", MESSAGES)
def test_all_runs_and_all_but_nonlinear_protocols_is_predicted(messages: str, pace: Pace) -> None:
    """For every kind of messages and of process noise, in both paces."""
    assert missing_laws(messages, pace, "run") == []
    assert missing_laws(messages, pace, "predict") == ["protocol that is not linear"]


@pytest.mark.parametrize("messages", MESSAGES)
@pytest.mark.parametrize("law", [law for law in LAWS if "protocol" not in law])
def test_what_it_says_runs_does(law: str, messages: str) -> None:
    """Ten steps of the twin in both paces."""
    for pace in ("lockstep", "realtime"):
        what = with_messages(messages, law, pace)
        assert unavailable(what) == []
        assert simulate(what.with_run(duration=0.5)).completeness.complete
