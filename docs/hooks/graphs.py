"""MkDocs hook: the comment ``<!-- graphs: line_ring -->`` in a page becomes the graphs of this example.

They are drawn from its file by the code that draws them in the report, in the colours of the report.
"""

from __future__ import annotations

import re
from html import escape
from typing import TYPE_CHECKING, Any

import yaml
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from msg_analysis.errors import InputError
from msg_analysis.experiment import examples
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.report.drawings import graph_drawings
from msg_analysis.report.plot_style import DARK, GRAPHS

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

COMMENT = re.compile(r"<!-- graphs: (\w+) -->")
SHEET = "assets/graph_colours.css"


def on_config(config: MkDocsConfig, /) -> MkDocsConfig:
    """Have every page load the colours."""
    config.extra_css.append(SHEET)
    return config


def on_files(files: Files, /, *, config: MkDocsConfig) -> Files:
    """Write the colours, for the light and the dark scheme, as a style sheet of the site."""
    schemes = {":root": GRAPHS, "[data-md-color-scheme=slate]": [DARK[colour] for colour in GRAPHS]}
    rules = [
        f"{where} {{ {' '.join(f'--graph-{mode}: {colour};' for mode, colour in enumerate(colours))} }}"
        for where, colours in schemes.items()
    ]
    files.append(File.generated(config, SHEET, content="\n".join(rules)))
    return files


def on_page_content(html: str, /, *, page: Page, **_: Any) -> str:
    """Draw the graphs of the examples that a page names.

    Raises
    ------
    PluginError : there is no example of this name
    """

    def drawn(match: re.Match[str]) -> str:
        try:
            experiment = Experiment.parse(yaml.safe_load(examples.text_of(match[1])))
        except InputError as error:
            raise PluginError(f"{page.file.src_uri}: {match[0]}: {error}") from error
        figures = "".join(
            f"<figure>{drawing}<figcaption>{escape(graph.name)}</figcaption></figure>"
            for graph, drawing in zip(experiment.graph_list, graph_drawings(experiment), strict=False)
        )
        return f'<div class="graphs" data-search-exclude>{figures}</div>'

    return COMMENT.sub(drawn, html)
