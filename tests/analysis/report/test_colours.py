"""The colours of plots: contrast to the page in both schemes (WCAG 2.2, level AA), and a way back from each."""

from __future__ import annotations

import pytest

from msg_analysis.report.html.plots import colours


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
    seen = colours.DARK if dark else {colour: colour for colour in colours.DARK}
    page = seen[colours.PAGE]
    assert _contrast(seen[colours.INK], page) >= 4.5
    for colour in {*colours.LINES, *colours.GRAPHS, colours.GREY}:
        assert _contrast(seen[colour], page) >= 3.0, colour


def test_numbers_are_read_on_the_scale() -> None:
    for scale, ink in ((colours.SCALE, colours.BLACK), (colours.DARK_SCALE, colours.DARK[colours.BLACK])):
        assert min(_contrast(colour, ink) for colour in scale) >= 4.5


def test_every_colour_has_its_own_in_the_dark() -> None:
    assert len(set(colours.DARK.values())) == len(colours.DARK)
    assert {*colours.LINES, *colours.GRAPHS, colours.INK, colours.GREY, colours.PALE} <= set(colours.DARK)
    assert set(colours.LINES) == set(colours.GRAPHS)
