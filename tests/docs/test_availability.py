"""What docs/network.md says is available, in "What is available"."""

from __future__ import annotations

import pytest

from msg_analysis.report.documents import LAWS, MESSAGES, availability_table, experiment
from msg_analysis.twin.simulate import simulate


def test_all_runs_and_all_but_nonlinear_protocols_is_predicted() -> None:
    """For every kind of messages and of process noise, in both paces."""
    rows = [line.strip("| ").split(" | ") for line in availability_table().splitlines()[2:]]
    assert [messages for messages, *_ in rows] == list(MESSAGES)
    assert all(cells == ["all laws", "linear laws"] * 2 for _, *cells in rows)


@pytest.mark.parametrize("messages", MESSAGES)
@pytest.mark.parametrize("law", [law for law in LAWS if "protocol" not in law])
def test_what_it_says_runs_does(law: str, messages: str) -> None:
    """Ten steps of the twin in both paces."""
    for pace in ("lockstep", "realtime"):
        what = experiment(messages, law, pace)  # type: ignore[arg-type]
        assert what.unavailable() == []
        assert simulate(what.with_run(duration=0.5)).completeness.complete
