"""Figures of a run: what the verdict names is marked, events, thinned series, colours that can be told apart."""

import dataclasses
import re

import numpy as np
import pytest

from experiments import Completeness, Experiment, Run, claimed, compare, document, line_ring, simulate
from msg_analysis.common import arrays
from msg_analysis.inference.comparison import Comparison
from msg_analysis.report import plot_style
from msg_analysis.report.drawings import chain_drawing, graph_drawings, interval_bars, plus_minus
from msg_analysis.report.error_plots import covariances, evidence
from msg_analysis.report.look import places
from msg_analysis.report.page import render
from msg_analysis.report.plot_style import Candidates, envelope, thin, thin_together
from msg_analysis.report.run_plots import run_events, trajectory_plots

DOCUMENT = document(name="marked", run={"duration": 60, "replicas": 8, "seed": 1, "start": "zero"})
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
    did = simulate(Experiment.parse(DOCUMENT | {"noise": {"process": [1, 2, 1]}}))
    return compare(claimed(did, Experiment.parse(DOCUMENT)))


def test_the_difference_of_the_covariances(louder: Comparison) -> None:
    """Its diagonal is the z of the agents, which are computed from other combinations."""
    expected = [node.z for node in louder.given.node_errors]
    assert np.allclose(np.diag(louder.covariance.z), np.array(expected, dtype=float), rtol=1e-6)
    assert np.allclose(louder.covariance.z, louder.covariance.z.T)


def test_the_cause_is_the_headline(louder: Comparison) -> None:
    text = render(louder)
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


PERIOD = 50_000_000  # ns of simulated time


def _run(**run: object) -> Run:
    line = {"graphs": {"line": {"path": [1, 2, 3]}}, "switching": {}}
    return simulate(line_ring(**line, run={"duration": 10, "start": "zero"} | run))


@pytest.mark.parametrize("block", [6, 10**6])  # numbers that are looked at together
def test_late_steps(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "BLOCK_NUMBERS", block)
    trajectory = _run(pace="realtime", speed=5)
    assert run_events(trajectory) == ([], 0)
    made = trajectory.made.copy()
    made[20:30, 1] += 2 * PERIOD
    made[33, 1] += 2 * PERIOD  # near: the same event
    made[60, 1] += 2 * PERIOD
    made[25, 2] += 2 * PERIOD
    made[100, 0] += PERIOD // 2  # not late
    found, more = run_events(dataclasses.replace(trajectory, made=made))
    assert more == 0
    assert [(one.kind, one.first, one.last, one.words) for one in found] == [
        ("late", 20, 33, "agent 2: late by more than a period in 11 steps"),
        ("late", 25, 25, "agent 3: late by more than a period in 1 step"),
        ("late", 60, 60, "agent 2: late by more than a period in 1 step"),
    ]


def test_missing_states_and_the_network() -> None:
    trajectory = _run()
    trajectory.states[7:10, 2] = np.nan
    trajectory = dataclasses.replace(trajectory, completeness=Completeness(expected=603, received=600, missing=3))
    reported = [
        {"kind": "back", "step": 50, "node": "agent_1", "words": "agent_1: back"},
        {"kind": "killed", "step": 40, "node": "agent_1", "words": "agent_1: killed"},
        {"kind": "never-seen", "step": 1, "node": "x", "words": "x"},
    ]
    found, _ = run_events(trajectory, reported)
    assert [(one.kind, one.first, one.last) for one in found] == [
        ("missing", 7, 9),
        ("killed", 40, 40),
        ("back", 50, 50),
    ]
    plots, _ = trajectory_plots(trajectory, None, found)
    assert plots["events"].select_one({"name": "events"}).data["lane"] == [2, 0, 1]
    assert "events" not in trajectory_plots(trajectory, None)[0]


def test_not_more_than_can_be_seen() -> None:
    trajectory = _run(pace="realtime", speed=5)
    made = trajectory.made.copy()
    for first, length in ((10, 1), (30, 4), (60, 2), (90, 1)):
        made[first : first + length, 0] += 2 * PERIOD
    found, more = run_events(dataclasses.replace(trajectory, made=made), most=2)
    assert [one.first for one in found] == [30, 60]
    assert more == 2


@pytest.fixture
def states() -> np.ndarray:
    return np.random.default_rng(3).standard_normal((103, 4, 3))


@pytest.mark.parametrize("block", [1, 100, 10**6])  # numbers that are looked at together
def test_bins(states: np.ndarray, block: int) -> None:
    found = thin(states, 1, None, 100, block)
    assert found.width == 9  # 2 * 103 * 4 / 100, rounded up
    values = states[:, :, 1]
    apart = values - values.mean(axis=1, keepdims=True)
    for pair, series in (
        (found.values, values),
        (found.deviations, apart),
        (found.centre, values.mean(axis=1, keepdims=True)),
        (found.error, (apart**2).sum(axis=1, keepdims=True)),
    ):
        parts = [series[first : first + 9] for first in range(0, 103, 9)]
        assert np.allclose(pair[0], [part.min(axis=0) for part in parts])
        assert np.allclose(pair[1], [part.max(axis=0) for part in parts])
    low, high = envelope(found.values)
    assert np.allclose(low, [values[first : first + 9].min() for first in range(0, 103, 9)])
    assert np.allclose(high, [values[first : first + 9].max() for first in range(0, 103, 9)])


@pytest.mark.parametrize("block", [100, 10**6])
@pytest.mark.parametrize("numbers", [100, 10**4])
def test_several_replicas(states: np.ndarray, block: int, numbers: int) -> None:
    """Each as if it were thinned alone."""
    together = thin_together(states, slice(1, 3), 0.25, numbers, block)
    for found, replica in zip(together, (1, 2), strict=True):
        alone = thin(states, replica, 0.25, numbers, block)
        assert found.width == alone.width
        for name in ("values", "deviations", "centre", "error"):
            for one, other in zip(getattr(found, name), getattr(alone, name), strict=True):
                np.testing.assert_array_equal(one, other)


def test_short_runs_are_kept_whole(states: np.ndarray) -> None:
    found = thin(states, 0, 0.5)
    assert found.width == 1
    assert found.values[0] is found.values[1]
    assert np.allclose(found.values[0], states[:, :, 0])
    assert np.allclose(found.error[0][:, 0], ((states[:, :, 0] - 0.5) ** 2).sum(axis=1))


def test_gaps_and_huge_numbers(states: np.ndarray) -> None:
    states[20:30, 2] = np.nan
    states[0, 0] = 1e300
    found = thin(states, 0, None, numbers=100)
    assert np.isnan(found.values[0][:, 2]).nonzero()[0].tolist() == []  # no bin is without a value: 18-26, 27-35
    states[18:27, 2] = np.nan
    assert np.isnan(thin(states, 0, None, numbers=100).values[0][:, 2]).nonzero()[0].tolist() == [2]
    assert np.isfinite(found.values[1][0, 0])
    assert np.isfinite(found.error[1][0, 0])


def test_a_run_of_any_length_has_one_size() -> None:
    for steps in (30_000, 300_000):
        found = thin(np.zeros((steps, 5, 1), np.float32), 0, None)
        assert found.values[0].size + found.values[1].size <= plot_style.NUMBERS + 10
    assert arrays.BLOCK_NUMBERS == plot_style.BLOCK_NUMBERS


def _light(colour: str) -> float:
    """Relative luminance, https://www.w3.org/TR/WCAG22/#dfn-relative-luminance."""
    parts = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _contrast(one: str, other: str) -> float:
    high, low = sorted((_light(one), _light(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("dark", [False, True])
def test_contrast(dark: bool) -> None:
    seen = plot_style.DARK if dark else {colour: colour for colour in plot_style.DARK}
    page = seen[plot_style.PAGE]
    assert _contrast(seen[plot_style.INK], page) >= 4.5
    for colour in {*plot_style.LINES, *plot_style.GRAPHS, plot_style.GREY}:
        assert _contrast(seen[colour], page) >= 3.0, colour


def test_agents_graphs_and_what_is_rejected_have_different_colours() -> None:
    agents, graphs = set(plot_style.LINES), set(plot_style.GRAPHS)
    assert len(agents) == len(graphs) == 8
    assert not agents & graphs
    assert plot_style.VERMILLION not in agents | graphs


def test_grids_are_drawn_as_grids() -> None:
    """Row by row, in steps of one length, whatever the other graphs."""
    other = {"path": [*range(1, 13)]}
    where = places(line_ring(12, graphs={"path": other, "grid": {"grid": [3, 4]}}).graph_list)
    steps = np.array([where[i + 1] - where[i] for i in (0, 1, 2, 4, 5)])
    np.testing.assert_allclose(steps, np.tile(steps[0] * [1, 0], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(where[4] - where[0], [0.0, -steps[0, 0]], atol=1e-12)


def test_colours_are_read_and_have_their_own_in_the_dark() -> None:
    for scale, ink in (
        (plot_style.SCALE, plot_style.BLACK),
        (plot_style.DARK_SCALE, plot_style.DARK[plot_style.BLACK]),
    ):
        assert min(_contrast(colour, ink) for colour in scale) >= 4.5


def test_evidence_is_drawn_as_large_as_it_is() -> None:
    plot = evidence(np.array([0.0, 1.0]), np.array([0.0, 255 * np.log(10.0)]), 100.0, 0.5)
    assert plot.y_range.end > 1e255
