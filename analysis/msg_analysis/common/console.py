# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Consoles of rich for both command lines, and notes on stderr; not in ``text``, since rich takes long to import."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from msg_analysis.common.text import visible


class SafeConsole(Console):
    """A rich console that prints control characters of texts as escapes; its own are in segments of their own."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Segments of something that is printed; see rich."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)


class ResultConsole(SafeConsole):
    """For tables on stdout."""

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print; sentences are wrapped for readers at a terminal, not for programs."""
        if not self.is_terminal and all(isinstance(each, str | Text) for each in objects):
            options.setdefault("soft_wrap", True)
        super().print(*objects, **options)

    def on_broken_pipe(self) -> None:
        """Rich exits with 1, which means "disagrees" here."""
        raise BrokenPipeError


def print_note(line: str, console: Console | None = None) -> None:
    """Print one line after a coloured ``note:``; ``console``: that of the live display which is shown meanwhile."""
    console = console or SafeConsole(stderr=True)
    console.print(Text("note: ", style="bold yellow") + Text(line), soft_wrap=True)
