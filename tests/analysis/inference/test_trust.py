# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Which errors of a run the verdict says to trust: with infinite fourth moments, few sojourns, and without either."""

import pytest
from tests.analysis.theory.tails.test_fourth_moments import HEAVY, LOSSY

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.online_errors import LiveEstimate
from msg_analysis.inference.verdict import compare, compare_pooled
from msg_analysis.report.wording import trust_words
from msg_analysis.twin.simulate import new_record, simulate

LINE_RING = {
    "name": "line_ring",
    "graphs": {
        "line": {"edges": [[1, 2], [2, 3], [3, 4], [4, 5]]},
        "ring": {"edges": [[1, 2], [2, 3], [3, 4], [4, 5], [5, 1]]},
    },
    "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
    "noise": {"process": 1.0},
    "run": {"dt": 0.1, "duration": 400.0, "seed": 3},
}


def compared(document, **changes):
    return compare(simulate(Experiment.parse(document | changes)))


@pytest.mark.parametrize("document", [HEAVY, LOSSY], ids=["switching", "losses"])
def test_heavy_tails(document):
    """No standard error over all paths, in no part of the document; what is given the path stays, and is tested."""
    run = document["run"] | {"duration": 400 * document["run"]["dt"], "seed": 5}
    found = compared(document, run=run)
    assert (found.trust.errors, found.trust.reason) == ("given_path", "heavy_tails")
    for error in (found.system_error, *found.node_errors):
        assert error.measured is not None
        assert error.predicted is not None
        assert error.standard_error is error.z is error.p is None
    assert found.given.system_error.z is not None
    assert found.given.variance_ratio is None
    assert found.order is None
    assert found.any_time.half_width is None
    assert not found.running["standard_error"].any()
    tests = {test.name: test.p for test in found.tests}
    assert tests["system error, corrected"] == pytest.approx(found.given.system_error.p)
    [words] = trust_words(found.to_json())
    assert "infinite" in words
    assert "Trust the errors corrected for the graph sequence" in words


def test_heavy_tails_of_several_runs():
    runs = [
        (str(seed), simulate(Experiment.parse(HEAVY | {"run": {"dt": 0.6, "duration": 240.0, "seed": seed}})))
        for seed in (1, 2)
    ]
    found = compare_pooled(runs)
    assert found.trust.reason == "heavy_tails"
    assert found.system_error.standard_error is None
    assert all(member.system_error.standard_error is None for member in found.pool.members)


def test_heavy_tails_live():
    live = LiveEstimate(new_record(Experiment.parse(HEAVY)))
    assert "infinite" in live.report().note


@pytest.mark.parametrize(
    ("document", "errors", "reason"),
    [
        (LINE_RING, "all_paths", None),
        (LINE_RING | {"switching": {"generator": [[-0.03, 0.03], [0.03, -0.03]]}}, "given_path", "few_sojourns"),
        (LINE_RING | {"switching": {"generator": [[-0.001, 0.001], [0.001, -0.001]]}}, "given_path", "short_run"),
        (LINE_RING | {"noise": {"process": 1.0, "loss": 0.2, "on_loss": "hold"}}, "given_path", "kept_values"),
    ],
)
def test_other_laws(document, errors, reason):
    found = compared(document)
    assert (found.trust.errors, found.trust.reason) == (errors, reason)
    assert found.to_json()["trust"]["reason"] == reason
    assert bool(trust_words(found.to_json())) == (reason == "few_sojourns")


def test_real_time_has_none():
    """There errors are given the log, whatever the law over all paths is."""
    document = LINE_RING | {"run": LINE_RING["run"] | {"pace": "realtime", "duration": 40.0}}
    assert compared(document).trust is None
