"""The colours of plots: contrast to the page in both schemes (WCAG 2.2, level AA), and a way back from each."""

from __future__ import annotations

import pytest

from msg_analysis.report import plot_style


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


def test_numbers_are_read_on_the_scale() -> None:
    for scale, ink in (
        (plot_style.SCALE, plot_style.BLACK),
        (plot_style.DARK_SCALE, plot_style.DARK[plot_style.BLACK]),
    ):
        assert min(_contrast(colour, ink) for colour in scale) >= 4.5


def test_every_colour_has_its_own_in_the_dark() -> None:
    assert len(set(plot_style.DARK.values())) == len(plot_style.DARK)
    assert {*plot_style.LINES, *plot_style.GRAPHS, plot_style.INK, plot_style.GREY, plot_style.PALE} <= set(
        plot_style.DARK
    )
    assert set(plot_style.LINES) == set(plot_style.GRAPHS)
