"""The table of what is available: the one in the documentation is what the code says."""

from __future__ import annotations

from pathlib import Path

import pytest

from msg_analysis.report.documents.availability import LAWS, MESSAGES, availability_table, experiment
from msg_analysis.twin.simulate import simulate

NETWORK = Path(__file__).parents[2] / "docs/network.md"


def test_the_documentation_has_it() -> None:
    assert availability_table() in NETWORK.read_text(encoding="utf-8"), (
        "put there what msg_analysis.report.documents.availability.availability_table() gives"
    )


@pytest.mark.parametrize("messages", MESSAGES)
@pytest.mark.parametrize("law", [law for law in LAWS if "protocol" not in law])
def test_what_it_says_runs_does(law: str, messages: str) -> None:
    """Ten steps of the twin in both paces."""
    for pace in ("lockstep", "realtime"):
        what = experiment(messages, law, pace)  # type: ignore[arg-type]
        assert what.unavailable() == []
        assert simulate(what.with_run(duration=0.5)).completeness.complete
