"""MkDocs hook: LaTeX between dollars becomes MathML, which browsers draw by themselves, without scripts or network."""

from __future__ import annotations

import re
from html import unescape
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

# What pymdownx.arithmatex leaves with `generic: true`.
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(html: str, /, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Draw the equations of a page.

    Raises
    ------
    PluginError : an equation has a command that is not known, or what comes out is not well-formed
    """

    def drawn(match: re.Match[str]) -> str:
        latex = unescape(match[3]).strip()
        block = match[2] == "["
        mathml = convert(latex, display="block" if block else "inline")
        try:
            unknown = "\\" in "".join(ElementTree.fromstring(mathml).itertext())
        except ElementTree.ParseError:
            unknown = True
        if unknown:
            raise PluginError(f"{page.file.src_uri}: cannot draw the equation {latex}")
        # The letters of an equation, one by one, are nothing to search for.
        return f'<div class="equation" data-search-exclude>{mathml}</div>' if block else mathml

    return EQUATION.sub(drawn, html)
