"""MkDocs hook: LaTeX between dollars becomes MathML, which browsers draw by themselves, without scripts or network."""

from __future__ import annotations

import re
from html import unescape
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

ElementTree.register_namespace("", "http://www.w3.org/1998/Math/MathML")

if TYPE_CHECKING:
    from mkdocs.structure.pages import Page

SIGNS = frozenset("−+")
OPENING = frozenset("([{=<>≤≥⪯,;|→↦")  # after these a minus is a sign, not a difference
# What pymdownx.arithmatex leaves with `generic: true`.
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(html: str, /, *, page: Page, **_: Any) -> str:
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
            tree = ElementTree.fromstring(mathml)
        except ElementTree.ParseError as error:
            raise PluginError(f"{page.file.src_uri}: cannot draw the equation {latex}: {error}") from error
        if "\\" in "".join(tree.itertext()):
            raise PluginError(f"{page.file.src_uri}: unknown command in the equation {latex}")
        set_spaces(tree)
        mathml = ElementTree.tostring(tree, encoding="unicode")
        # The letters of an equation, one by one, are nothing to search for.
        return f'<div class="equation" data-search-exclude>{mathml}</div>' if block else mathml

    return EQUATION.sub(drawn, html)


def set_spaces(tree: ElementTree.Element) -> None:
    """Space signs and infinity as letters: browsers would space them as operators between two operands."""
    for parent in tree.iter():
        before = None
        for child in parent:
            operator = child.tag.endswith("}mo")
            begins = before is None or (before.tag.endswith("}mo") and before.text in OPENING)
            if operator and child.text == "∞":
                child.tag = child.tag.removesuffix("mo") + "mi"
            elif operator and child.text in SIGNS and begins and parent.tag.endswith(("}mrow", "}mtd")):
                child.set("form", "prefix")
            before = child
