"""What docs/network.md says is available, in "What is available": it runs, here in the twin, and is predicted."""

from pathlib import Path
from typing import Any

import pytest

from experiments import TRACKING, line_ring, simulate
from msg_analysis.experiment.limits import prediction_method, unavailable

BY_LINK = {"loss": {"default": 0.1, "arcs": [[1, 2, 0.5]]}}
BURSTS, HOLD = {"loss": 0.2, "burst": 5}, {"on_loss": "hold"}
EVERYTHING = {"broadcast": 0.5, "link": 0.5, "delay": 2, **BY_LINK, "burst": 5}
MESSAGES: dict[str, dict[str, Any]] = {
    "as they are": {},
    "`broadcast` noise": {"broadcast": 0.5},
    "`link` noise": {"link": 0.5},
    "`loss`, own value": {"loss": 0.2},
    "`loss`, last value heard": {"loss": 0.2, **HOLD},
    "`loss` by link, own value": BY_LINK,
    "`loss` by link, last value heard": BY_LINK | HOLD,
    "`loss` in bursts, own value": BURSTS,
    "`loss` in bursts, last value heard": BURSTS | HOLD,
    "`delay`": {"delay": 2},
    "all of these, own value": EVERYTHING,
    "all of these, last value heard": EVERYTHING | HOLD,
}
"""Sections ``noise``, beside the process noise, by what they make of messages."""
LAWS = {"consensus": {}, "leaders": TRACKING, "held": TRACKING | {"leaders": {"agents": [1], "gain": "inf"}}}
PROCESS_NOISE = (0.0, 1.0, [1.0, 0.5], [[1.0, 0.2], [0.0, 1.0]], {"line": 1.0, "ring": 2.0})
GRAPHS = {"line": {"path": [1, 2]}, "ring": {"arcs": [[1, 2], [2, 1]]}}


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
@pytest.mark.parametrize("messages", MESSAGES)
@pytest.mark.parametrize("law", LAWS)
def test_every_law_with_every_kind_of_messages(law: str, messages: str, pace: str) -> None:
    """Ten steps, with any process noise."""
    run = {"duration": 0.5, "pace": pace}
    for process in PROCESS_NOISE:
        noise = {"process": process, **MESSAGES[messages]}
        what = line_ring(2, graphs=GRAPHS, noise=noise, run=run, **LAWS[law])
        assert unavailable(what) == unavailable(what, "predict") == []
        assert simulate(what).completeness.complete


def method(agents: int, pace: str, changes: dict[str, Any]) -> str:
    """How the errors of a complete graph and a ring are known."""
    everybody = list(range(1, agents + 1))
    graphs = {"complete": {"complete": True, "weight": 0.1}, "ring": {"cycle": everybody}}
    fields = {"agents": agents, "graphs": graphs} | changes
    run = {"dt": 0.01, "duration": 1, "pace": pace, "start": "zero"}
    return prediction_method(line_ring(agents, **fields, run=run))[0]


def test_the_table() -> None:
    """Of 5 and of 60 agents, in lockstep and in real time, as ``info`` says it."""
    rows: dict[str, dict[str, Any]] = {
        **{f"messages: {name}": {"noise": noise} for name, noise in MESSAGES.items()},
        "`whole_link`, own value": {"noise": {"loss": 0.2, "whole_link": True}},
        "`whole_link`, last value heard": {"noise": {"loss": 0.2, "whole_link": True, **HOLD}},
        "a ring of links that switch by themselves": {
            "switching": {"links": {"up": 1.0, "down": 0.5}},
        },
        "agents that leave out steps, on a ring": {"noise": {"activation": 0.7}, "switching": {}},
        "a given sequence of graphs": {"switching": {"schedule": [[0, "ring"], [0.5, "complete"]]}},
        "a linear protocol": {"protocol": {"name": "metropolis", "laziness": 0.3}},
        "a nonlinear protocol": {"protocol": {"name": "saturated"}},
    }
    table = ["| | 5 agents, lockstep | real time | 60 agents, lockstep | real time |", "|---|---|---|---|---|"]
    for name, changes in rows.items():
        cells = []
        for agents in (5, 60):
            if name.endswith("a ring") or "a ring of" in name:
                changes = changes | {"graphs": {"ring": {"cycle": list(range(1, agents + 1))}}}
            cells += [method(agents, pace, changes) for pace in ("lockstep", "realtime")]
        table.append(f"| {name} | {' | '.join(cells)} |")
    assert "\n".join(table) in (Path(__file__).parents[2] / "docs/network.md").read_text(encoding="utf-8"), "\n".join(
        table
    )
