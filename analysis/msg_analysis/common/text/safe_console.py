"""The consoles of both command lines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from msg_analysis.common.text.safe_text import visible


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
