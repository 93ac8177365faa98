# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The report of a log of any origin: what the terminal says, and a picture of states, graphs and innovations."""

from __future__ import annotations

import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from scipy.stats import chi2

from msg_analysis.common.files import write_whole
from msg_analysis.common.text import agent_name
from msg_analysis.report.figures import (
    MOST_LINES,
    MOST_POINTS,
    STYLE,
    draw_path,
    legend_beside,
    plain,
    rendered,
    stacked_panels,
)
from msg_analysis.report.log_text import print_log_comparison
from msg_analysis.report.look import shorten
from msg_analysis.report.plot_style import BLUE, GREY, LINES, VERMILLION

if TYPE_CHECKING:
    from msg_analysis.inference.log_verdict import LogComparison

WIDTH = 100  # characters
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>
body {{ max-width: 62rem; margin: 2rem auto; padding: 0 1rem; font-family: sans-serif; }}
pre {{ white-space: pre-wrap; font-size: 0.85rem; }} svg {{ width: 100%; height: auto; }}
</style></head><body><h1>{title}</h1>
<pre>{text}</pre>
{picture}
</body></html>
"""


def write_log_report(comparison: LogComparison, file: str | Path) -> Path:
    """Write the comparison of a log as one self-contained HTML page, whole or not at all; its path."""
    console = Console(record=True, width=WIDTH, file=io.StringIO())
    print_log_comparison(comparison.to_json(), console, verbose=True)
    text = console.export_html(inline_styles=True, code_format="{code}")
    picture = rendered(log_figure(comparison), "svg", 96.0).decode()
    title = html.escape(f"{comparison.log.law.name}: a log and its law")
    page = PAGE.format(title=title, text=text, picture=picture[picture.index("<svg") :])
    return write_whole(Path(file), page.encode())


def log_figure(comparison: LogComparison) -> Figure:
    """States of the first agents over time, the graphs, and each agent's squared innovations over their expectation."""
    log = comparison.log
    law, few = log.law, min(log.law.agents, MOST_LINES)
    every = max(1, -(-len(log.times) // MOST_POINTS))
    with mpl.rc_context(STYLE):
        figure, (states, *band, ratios) = stacked_panels(3.0, *([] if log.hidden else [0.7]), 2.0)
        for agent in range(few):
            label = plain(shorten(f"agent {agent_name(agent + 1, law.names)}"))
            there = np.flatnonzero(~np.isnan(log.states[:, agent, 0]))[::every]
            states.plot(log.times[there], log.states[there, agent, 0], lw=0.9, color=LINES[agent], label=label)
        states.set(xlabel="simulated time", ylabel="state", xlim=(log.times[0], log.times[-1]))
        legend_beside(figure, "right upper", fontsize=8)
        for path in band:
            states.set_xlabel("")
            states.tick_params(labelbottom=False)
            ends = np.append(log.starts[1:], max(float(log.times[-1]), float(log.starts[-1])))
            draw_path(path, law, log.starts, ends, log.graphs)
            path.set_xlim(states.get_xlim())
        numbers = np.arange(1, law.agents + 1)
        counts = np.maximum(1, (~np.isnan(log.states)).sum(axis=(0, 2)))
        low, high = chi2.ppf(0.025, counts) / counts, chi2.ppf(0.975, counts) / counts
        found = np.array([np.nan if ratio is None else ratio for ratio in comparison.ratios], dtype=float)
        ratios.vlines(numbers, low, high, color=GREY, lw=5.0, alpha=0.4, label="95 % under the law")
        outside = (found < low) | (found > high)
        for which, colour in ((~outside, BLUE), (outside, VERMILLION)):
            ratios.plot(numbers[which], found[which], "o", color=colour, ms=4.5)
        ratios.axhline(1.0, color=GREY, lw=0.8)
        ratios.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
        ratios.set(xlabel="agent", ylabel="squared innovations\nover expected")
        ratios.legend(loc="upper right", fontsize=8)
    return figure
