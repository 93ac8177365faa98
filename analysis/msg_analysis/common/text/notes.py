"""Notes to the user on stderr."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_note(line: str, console: Console | None = None) -> None:
    """Print one line after a coloured ``note:``; ``console``: that of the live display which is shown meanwhile."""
    from rich.text import Text

    from msg_analysis.common.text.safe_console import SafeConsole

    console = console or SafeConsole(stderr=True)
    console.print(Text("note: ", style="bold yellow") + Text(line), soft_wrap=True)
