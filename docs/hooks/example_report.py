"""MkDocs hook: the report of the twin's run of an example is a file of the site, made when the site is built.

A page shows it in place of the comment ``<!-- report -->``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import yaml
from mkdocs.structure.files import File, Files
from mkdocs.utils import get_relative_url

from msg_analysis.experiment import examples
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.pool import compare
from msg_analysis.report.page import render
from msg_analysis.twin.simulate import simulate

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

EXAMPLE = "line_ring"
FILE = f"reports/{EXAMPLE}.html"
COMMENT = "<!-- report -->"
COMMANDS = (
    f"msg-analysis simulate {EXAMPLE} --out {EXAMPLE}_twin",
    f"msg-analysis compare {EXAMPLE}_twin --report {EXAMPLE}.html",
)


def on_files(files: Files, /, *, config: MkDocsConfig) -> Files:
    """Simulate the example, compare it with its prediction, and add the report to the site."""
    run = simulate(Experiment.parse(yaml.safe_load(examples.text_of(EXAMPLE))))
    run.record.versions.pop("host", None)  # the report is published
    html = render(compare(run), host="the computer that built this site", command=" && ".join(COMMANDS))
    files.append(File.generated(config, FILE, content=html))
    return files


def on_page_content(html: str, /, *, page: Page, **_: Any) -> str:
    """Link the report, and show it within the page."""
    address = get_relative_url(FILE, page.url)
    return html.replace(
        COMMENT,
        f'<p><a class="md-button md-button--primary" href="{address}" target="_blank" rel="noopener">'
        "Open the report in a tab of its own</a></p>\n"
        f'<iframe class="report" src="{address}" title="Report of a run of {EXAMPLE}" loading="lazy"></iframe>',
    )
