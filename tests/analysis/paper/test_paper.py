"""The paper's examples: numbers against brute-force Kronecker algebra and known digits, and the files."""

import csv
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import errata
import matplotlib as mpl
import numpy as np
import pytest
import scipy.linalg
from matplotlib.figure import Figure
from matplotlib.text import Text

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.paper import examples as paper
from msg_analysis.paper import figures
from msg_analysis.paper.examples import CENTRALITY, NODE, SYSTEM, Curve, Example

ROOT = Path(__file__).parents[3]
EXPERIMENTS = ROOT / "analysis/msg_analysis/experiment/bundled"

GRAPHS = {
    "line_ring": (["12", "23", "34", "45"], ["12", "23", "34", "45", "15"]),
    "three_lines": (["23", "34", "45", "15"], ["12", "23", "34", "45"], ["15", "12", "23", "34"]),
    "knife_edge": (["12", "13", "15", "34", "45"], ["13", "15", "23", "24", "34", "45"]),
    "smallest": (["12", "13", "14", "35"], ["12", "13", "34", "35", "45"]),
}
"""The edges as they are known, written again."""


@pytest.fixture(scope="module")
def examples() -> dict[int, Example]:
    return {number: example(12) for number, example in paper.EXAMPLES.items()}


def laplacians(network: str) -> list[np.ndarray]:
    return [errata.laplacian([(int(a), int(b)) for a, b in edges], 5) for edges in GRAPHS[network]]


def generator(network: str, epsilon: float, r12: float, r21: float) -> np.ndarray:
    if network != "three_lines":
        return epsilon * np.array([[-r12, r12], [r21, -r21]])
    return epsilon * np.array([[-r12, r12, 0], [r21, -2 * r21, r21], [0, r12, -r12]])


def brute_force(curve: Curve, point: int) -> float:
    """The paper's steady-state formula with its pseudo-inverse; F = I."""
    rates = generator(curve.network, curve.epsilon[point], curve.r12[point], curve.r21[point])
    share = scipy.linalg.null_space(rates.T)[:, 0]
    share /= share.sum()
    if curve.quantity == CENTRALITY:
        follows = [agent for agent in range(5) if agent != curve.agent]
        drifts = [errata.kron_sum(lap[np.ix_(follows, follows)]) for lap in laplacians(curve.network)]
        found = errata.pinv(errata.blocks(drifts) - np.kron(rates.T, np.eye(16))) @ np.kron(share, np.eye(4).ravel())
        return 1.0 / float(np.trace(found.reshape(-1, 4, 4).sum(axis=0)))
    errors = errata.continuous(laplacians(curve.network), share, rates, np.eye(5))
    return 1.0 / float(errors.sum() if curve.agent is None else errors[curve.agent])


@pytest.mark.parametrize("number", [1, 2, 3])
def test_curves_against_kronecker_algebra(examples: dict[int, Example], number: int) -> None:
    random = np.random.default_rng(number)
    for curve in examples[number].curves:
        for point in random.integers(len(curve.value), size=2):
            assert curve.value[point] == pytest.approx(brute_force(curve, point), rel=1e-9)


def at(curves: list[Curve], **rates: float) -> dict[int | None, float]:
    """Values by agent at the point with these rates."""
    found: dict[int | None, float] = {}
    for curve in curves:
        fits = np.all([np.isclose(getattr(curve, key), value, rtol=1e-12) for key, value in rates.items()], axis=0)
        if fits.any():
            found[curve.agent] = float(curve.value[fits.argmax()])
    return found


def test_known_digits_of_example_1(examples: dict[int, Example]) -> None:
    system = examples[1].select("line_ring", SYSTEM)
    for (r12, r21), digits in {(1.0, 1.0): 0.73561, (0.1, 1.0): 0.53439, (1.0, 0.1): 0.94031}.items():
        assert round(at(system, r12=r12, r21=r21)[None], 5) == digits
    nodes = at(examples[1].select("line_ring", NODE), r12=1.0, r21=1.0)
    assert [round(nodes[agent], 5) for agent in range(5)] == [2.90277, 4.25156, 5.0, 4.25156, 2.90277]
    for curve in system:
        assert np.all((curve.value > 0.5) & (curve.value < 1.0))  # between the line and the ring held
    assert len(system) == 2 * len(paper.LEVELS)


def test_known_digits_of_example_2(examples: dict[int, Example]) -> None:
    """The digits are those at r12 = 0.5, 0.5, 0.2 and 0.2; the largest values are a little above them."""
    digits = {0.5: (0.5, 0.51760), 1.0: (0.5, 0.53075), 5.0: (0.2, 0.59339), 10.0: (0.2, 0.63129)}
    for curve in examples[2].select("three_lines", SYSTEM):
        r12, value = digits[curve.epsilon[0]]
        assert round(at([curve], r12=r12)[None], 5) == value
        assert value <= curve.value[curve.peak] < value + 0.002
        assert 0 < curve.peak < len(curve.value) - 1
        assert np.all(np.diff(curve.value[: curve.peak + 1]) > 0)
        assert np.all(np.diff(curve.value[curve.peak :]) < 0)
        moved = replace(curve, r12=curve.r12[curve.peak] * np.array([0.98, 1.02]))
        assert max(brute_force(moved, point) for point in (0, 1)) < curve.value[curve.peak]


def orders(curves: list[Curve], *scales: float) -> list[str]:
    points = [int(np.abs(curves[0].epsilon - scale).argmin()) for scale in scales]
    return ["-".join(str(agent + 1) for agent in paper.order(curves, point)) for point in points]


def test_orders_of_example_3(examples: dict[int, Example]) -> None:
    knife = examples[3].select("knife_edge", CENTRALITY)
    assert orders(knife, 0.1, 1.0, 10.0) == ["1-3-4-5-2", "3-1-4-5-2", "1-3-4-5-2"]
    errors = {agent: 1.0 / value for agent, value in at(knife, epsilon=1.0).items()}
    assert (round(errors[2], 5), round(errors[0], 5)) == (1.63896, 1.63912)
    central, certain = (examples[3].select("smallest", quantity) for quantity in (CENTRALITY, NODE))
    assert set(orders(central, *central[0].epsilon)) == {"1-3-4-5-2"}
    assert set(orders(certain, *certain[0].epsilon)) == {"3-1-4-5-2"}


@pytest.mark.parametrize(
    ("name", "network", "rates"),
    [
        ("three_lines", "three_lines", (5.0, 0.2, 0.05)),
        ("leader_knife_edge", "knife_edge", (1.0, 1.0, 1.0)),
        ("leader_smallest", "smallest", (1.0, 1.0, 1.0)),
        ("line_ring", "line_ring", (0.5, 1.0, 1.0)),
    ],
)
def test_shipped_experiments_are_the_examples(
    examples: dict[int, Example], name: str, network: str, rates: tuple[float, float, float]
) -> None:
    experiment = Experiment.load(EXPERIMENTS / f"{name}.yaml")
    assert experiment.name == name
    expected = laplacians(network)
    drawn = next(example.networks[network] for example in examples.values() if network in example.networks)
    assert len(expected) == len(experiment.graph_list) == len(drawn)
    for graph, picture, laplacian in zip(experiment.graph_list, drawn, expected, strict=True):
        np.testing.assert_array_equal(graph.laplacian, laplacian)
        np.testing.assert_array_equal(picture.laplacian, laplacian)
    np.testing.assert_allclose(experiment.chain.matrix, generator(network, *rates), rtol=1e-15)
    assert ("reconstruction" in (EXPERIMENTS / f"{name}.yaml").read_text()) == (network != "line_ring")


@pytest.mark.parametrize("number", [1, 2, 3])
def test_table(examples: dict[int, Example], number: int) -> None:
    example = examples[number]
    lines = paper.csv_text(example).splitlines()
    comments = [line for line in lines if line.startswith("# ")]
    assert lines[: len(comments)] == comments
    assert any("reconstructed" in line for line in comments) == (number != 1)
    rows = list(csv.DictReader(lines[len(comments) :]))
    assert tuple(rows[0]) == paper.COLUMNS
    assert len(rows) == sum(len(curve.value) for curve in example.curves)
    for row in rows:
        epsilon, r12, r21 = float(row["epsilon [1/time]"]), float(row["r12"]), float(row["r21"])
        assert float(row["q12 [1/time]"]) == epsilon * r12
        assert float(row["q21 [1/time]"]) == epsilon * r21
        assert (row["agent"] == "0") == (row["quantity"] == SYSTEM)
    values = np.concatenate([curve.value for curve in example.curves])
    np.testing.assert_array_equal([float(row["value [1/variance]"]) for row in rows], values)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_figure_shows_graphs_and_says_what_is_reconstructed(examples: dict[int, Example], number: int) -> None:
    example = examples[number]
    with mpl.rc_context(figures._STYLE):
        figure = figures.draw(example)
        shown = [text.get_text() for text in figure.findobj(Text)]
    assert any("reconstructed" in text for text in shown) == (number != 1)
    drawn = [axes for axes in figure.axes if not axes.axison]
    assert len(drawn) == sum(len(graphs) for graphs in example.networks.values())
    for axes in [axes for axes in figure.axes if axes.axison]:
        assert axes.get_xlabel() or axes.get_shared_x_axes().get_siblings(axes)
        assert "1/E" in axes.get_ylabel() or "%" in axes.get_ylabel()
        styles = {(line.get_color(), str(line.get_linestyle()), line.get_marker()) for line in axes.lines}
        curves = [line for line in axes.lines if len(line.get_xdata()) > 2]
        assert len(styles) >= len(curves)  # each its own colour, dashes and marker


def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, example in list(paper.EXAMPLES.items()):
        monkeypatch.setitem(paper.EXAMPLES, number, cache(lambda example=example: example(6)))


def test_files_are_reproducible_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few_points(monkeypatch)
    (tmp_path / "example_2.svg").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    written = figures.write_figures([2], tmp_path)
    assert [path.name for path in written] == [f"example_2.{kind}" for kind in ("png", "svg", "pdf", "csv")]
    first = {path: path.read_bytes() for path in written}
    assert figures.write_figures([2], tmp_path) == written
    assert {path: path.read_bytes() for path in written} == first
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 5  # nothing temporary is left
    png, svg, pdf, _ = first.values()
    assert png.startswith(b"\x89PNG")
    assert svg.rstrip().endswith(b"</svg>")
    assert not re.search(rb"<dc:date>", svg)
    assert pdf.startswith(b"%PDF")
    assert not re.search(rb"/CreationDate|/FontType 3|/Type3", pdf)


def test_a_place_that_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is drawn."""
    few_points(monkeypatch)
    monkeypatch.setattr(figures, "draw", lambda *_: Figure())
    (tmp_path / "example_2.svg").mkdir()
    with pytest.raises(InputError, match=r"example_2\.svg.*cannot be written"):
        figures.write_figures([2], tmp_path, ["svg"])
    assert [path.name for path in tmp_path.iterdir()] == ["example_2.svg"]


def test_no_global_state_of_pyplot() -> None:
    """It would choose a backend, and keep figures in notebooks; nothing of the package loads it."""
    sources = (ROOT / "analysis/msg_analysis").rglob("*.py")
    assert [file.name for file in sources if "pyplot" in file.read_text(encoding="utf-8")] == []
