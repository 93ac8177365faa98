# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
