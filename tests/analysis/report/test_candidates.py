"""What the verdict names is marked in the pictures; covariances in standard errors; intervals as text and bars."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.verdict import compare
from msg_analysis.report.drawings import chain_drawing, graph_drawings, interval_bars, plus_minus
from msg_analysis.report.error_plots import covariances
from msg_analysis.report.page import render
from msg_analysis.report.plot_style import Candidates
from msg_analysis.twin.simulate import simulate

DOCUMENT = {
    "name": "marked",
    "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
    "switching": {"generator": [[-1, 1], [1, -1]]},
    "run": {"dt": 0.05, "duration": 60, "replicas": 8, "seed": 1, "start": "zero"},
}
CAUSE = {"kind": "noise", "agent": None, "link": None, "graph": None}


def cause(**changes: object) -> dict[str, object]:
    return CAUSE | changes


def test_who_is_named() -> None:
    found = Candidates.of(
        [
            cause(kind="gain", link=[2, 3], graph="ring"),
            cause(agent=3),
            cause(agent=3, kind="offset"),
            cause(kind="correlation", link=[1, 4]),
            cause(kind="switching", graph=["line", "ring"]),
            cause(kind="switching", graph=["ring"]),
            cause(kind="switching"),
        ]
    )
    assert found.agents == (3,)
    assert found.involved == [3, 2, 1, 4]
    assert found.links_of("ring") == {(2, 3)}
    assert found.links_of("line") == set()
    assert found.entries == [(2, 3), (1, 4)]
    assert found.jump("line", "ring")
    assert found.jump("ring", "star")
    assert not found.jump("line", "star")


def test_drawings() -> None:
    experiment = Experiment.parse(DOCUMENT)
    marked = Candidates(agents=(2,), links=((1, 3, None),), jumps=(("line", "ring"),))
    line, ring = graph_drawings(experiment, marked)
    assert line.count('class="candidate"') == 1  # the agent; it has no link 1-3
    assert ring.count('class="candidate"') == 2
    assert "named by the verdict: 1-3" in ring
    chain = chain_drawing(experiment, marked)
    assert chain is not None
    assert chain.count('class="candidate"') == 1
    assert 'class="candidate"' not in "".join(graph_drawings(experiment))


def test_frames_in_the_covariance() -> None:
    plots = covariances(np.eye(3), None, None, Candidates(agents=(2,), links=((1, 3, "ring"),)))
    frames = plots["covariance_measured"].select({"name": "candidates"})
    assert {(one.left, one.right, one.bottom, one.top) for one in frames} == {
        (0.5, 3.5, 1.5, 2.5),
        (1.5, 2.5, 0.5, 3.5),
        (2.5, 3.5, 0.5, 1.5),
        (0.5, 1.5, 2.5, 3.5),
    }
    assert list(plots) == ["covariance_measured"]


@pytest.fixture(scope="module")
def louder() -> Comparison:
    """Agent 2 has twice the noise that the record says."""
    said = Experiment.parse(DOCUMENT)
    did = simulate(Experiment.parse(DOCUMENT | {"noise": {"process": [1, 2, 1]}}))
    return compare(dataclasses.replace(did, record=dataclasses.replace(did.record, experiment=said)))


def test_the_difference_of_the_covariances(louder: Comparison) -> None:
    """Its diagonal is the z of the agents, which are computed from other combinations."""
    assert louder.covariance.z is not None
    assert louder.given is not None
    expected = [node.z for node in louder.given.node_errors]
    assert np.allclose(np.diag(louder.covariance.z), np.array(expected, dtype=float), rtol=1e-6)
    assert np.allclose(louder.covariance.z, louder.covariance.z.T)


def test_the_cause_is_the_headline(louder: Comparison) -> None:
    text = render(louder, louder.trajectory)
    headline = re.search(r"<strong>(.*?)</strong>", text)
    assert headline
    assert headline[1].startswith("✗ Agent 2&#39;s noise variance is")
    assert "The run disagrees with the prediction." in text
    assert 'data-candidates="[2]"' in text
    assert text.count('<b class="named"') == 1


@pytest.mark.parametrize(
    ("measured", "half", "text"),
    [
        (1.7218, 0.146, "1.722 ± 0.146"),
        (1.4401, 0.0764, "1.440 ± 0.076"),
        (40.543, 5.514, "40.54 ± 5.51"),
        (12345.6, 0.011, "12345.600 ± 0.011"),
        (-0.5, 0.1, "−0.5000 ± 0.1000"),
        (1e-9, 2e-10, "1.000e−09 ± 2e−10"),
        (0.0, 0.5, "0.000 ± 0.500"),
        (3.14159, None, "3.142"),
        (None, None, "–"),
    ],
)
def test_plus_minus(measured: float | None, half: float | None, text: str) -> None:
    interval = (None, None) if half is None or measured is None else (measured - half, measured + half)
    assert plus_minus(measured, interval) == text


def test_bars() -> None:
    rows = [
        {"measured": 1.1, "predicted": 1.0, "interval": [1.05, 1.15], "z": 4.0},
        {"measured": 2.0, "predicted": 2.0, "interval": [1.9, 2.1], "z": 0.0},
        {"measured": 2.0, "predicted": 2.0, "interval": [None, None], "z": None},
        {"measured": None, "predicted": 2.0, "interval": [None, None], "z": None},
    ]
    apart, on_it, alone, nothing = interval_bars(rows)
    reach = 1.05 * 0.15
    assert f"left:{50 + 50 * 0.1 / reach:.1f}%" in apart
    assert f"left:{50 + 50 * 0.05 / reach:.1f}%;width:{50 * 0.1 / reach:.1f}%" in apart
    assert 'class="bar apart"' in apart
    assert "+10 % of the prediction; z = +4.00" in apart
    assert 'class="bar"' in on_it
    assert "left:50.0%" in on_it
    assert "<i" not in alone
    assert nothing == ""
