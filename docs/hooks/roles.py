"""MkDocs hook: roles of reStructuredText in docstrings, such as :func:`predict`, become the code that they name."""

from __future__ import annotations

import re
from typing import Any

ROLE = re.compile(r":(?:attr|class|exc|func|meth|mod):(?=<code>)")


def on_page_content(html: str, /, **_: Any) -> str:
    """Leave the names, take the roles away."""
    return ROLE.sub("", html)
